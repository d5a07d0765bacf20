"""Runs the cells of a notebook as Jupyter does, and keeps what they show: python -m tests.tools.notebook examples/X.ipynb FOLDER"""

from __future__ import annotations

import ast
import base64
import io
import json
import os
import sys
from collections.abc import Iterator
from contextlib import chdir, redirect_stdout
from pathlib import Path
from typing import Any

from PIL import Image

QUALITY = 85  # of kept pictures, as JPEG


def run(notebook: dict[str, Any], folder: Path) -> None:
    """Run all cells in a folder, in order and with one set of names; each keeps its outputs."""
    names: dict[str, Any] = {"__name__": "__main__"}
    with chdir(folder):
        for number, cell in enumerate((one for one in notebook["cells"] if one["cell_type"] == "code"), 1):
            cell["execution_count"] = number
            cell["outputs"] = list(outputs("".join(cell["source"]), names, number))


def outputs(source: str, names: dict[str, Any], number: int) -> Iterator[dict[str, Any]]:
    """Run the source of a cell: what it prints, and the value of its last line, in nbformat's words."""
    tree, said, value = ast.parse(source), io.StringIO(), None
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    with redirect_stdout(said):
        exec(compile(tree, "<cell>", "exec"), names)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), names)
    if text := said.getvalue():
        yield {"output_type": "stream", "name": "stdout", "text": text.splitlines(True)}
    if value is not None:
        data: dict[str, Any] = {"text/plain": [repr(value)]}
        if isinstance(value, Image.Image):
            data = {"image/jpeg": encoded(value), "text/plain": [f"<picture of {value.width}x{value.height}>"]}
        yield {"output_type": "execute_result", "execution_count": number, "metadata": {}, "data": data}


def encoded(picture: Image.Image) -> str:
    """A picture as JPEG in base64."""
    file = io.BytesIO()
    picture.convert("RGB").save(file, "JPEG", quality=QUALITY)
    return base64.b64encode(file.getvalue()).decode()


if __name__ == "__main__":
    file = Path(os.path.abspath(sys.argv[1]))
    notebook = json.loads(file.read_text("utf-8"))
    run(notebook, Path(sys.argv[2]))
    file.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", "utf-8")
