"""SOG: PlayCanvas's packed Gaussians, the smallest on the web. Written by gaussforge, the extra `sog`, from a PLY."""

from __future__ import annotations

import importlib
import io
import json
import tempfile
import zipfile
from pathlib import Path

from stages.contract import StageError
from stages.formats.exchange.ply import write_ply
from stages.records import Scene


def check_sog() -> None:
    """StageError where gaussforge is missing."""
    try:
        importlib.import_module("gaussforge")
    except ImportError as error:
        raise StageError("writing SOG needs gaussforge", "pip install 'hugs-avatar[sog]'", [str(error)]) from error


def write_sog(path: Path, splats: Scene) -> None:
    """Write Gaussians as SOG, with its mark for anti-aliasing; StageError with what gaussforge says where it fails."""
    gaussforge = importlib.import_module("gaussforge")
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "plain.ply"
        write_ply(plain, splats, padded=False)  # colours of degree 3, even all 0, take minutes
        made = gaussforge.GaussForge().convert(plain.read_bytes(), "ply", "sog")
    if "data" not in made:
        raise StageError(f"gaussforge made no {path.name}", "leave sog out of export.formats", [str(made)[:200]])
    path.write_bytes(_marked(made["data"]) if splats.antialias else made["data"])


def _marked(packed: bytes) -> bytes:
    """The archive with the mark for anti-aliasing, which gaussforge leaves out: the format's own, and splat-transform's."""
    marked = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(packed)) as old, zipfile.ZipFile(marked, "w") as new:
        for entry in old.infolist():
            content = old.read(entry)
            if entry.filename == "meta.json":
                content = json.dumps(json.loads(content) | {"antialias": True, "model": "antialiased"}).encode()
            new.writestr(entry, content)
    return marked.getvalue()
