"""What a file is by its first bytes, and what a folder holds, for the words about what is not as was wanted."""

from __future__ import annotations

import codecs
import re
from pathlib import Path
from typing import Literal, NamedTuple

HEAD = 1024
LISTED = 12  # names of a folder's files in an error
What = Literal["picture", "sound", "archive", "playlist", "text"]
HEADS: tuple[tuple[bytes, What, str], ...] = (
    (rb"\xff\xd8\xff", "picture", "JPEG"),
    (rb"\x89PNG\r\n(?!.*acTL)", "picture", "PNG"),
    (rb"II\*\0|MM\0\*", "picture", "TIFF"),
    (rb"BM.{4}\0{4}", "picture", "BMP"),
    (rb"RIFF.{4}WEBP", "picture", "WebP"),
    (rb".{4}ftyp(heic|heix|mif1|avif)", "picture", "HEIF"),
    (rb"ID3|\xff[\xfb\xf3\xf2]", "sound", "MP3"),
    (rb"RIFF.{4}WAVE", "sound", "WAV"),
    (rb"fLaC", "sound", "FLAC"),
    (rb".{4}ftypM4A", "sound", "M4A"),
    (rb"PK\x03\x04", "archive", "zip"),
    (rb"\x1f\x8b", "archive", "gzip"),
    (rb"7z\xbc\xaf|Rar!", "archive", "7z or RAR"),
    (rb"%PDF", "text", "PDF"),
    (rb"\s*(#EXTM3U|ffconcat|\[playlist\]|(<\?xml[^>]*>\s*)?<(MPD|playlist))", "playlist", "names of films"),
    (rb"(?i)\s*(<!doctype html|<html)", "text", "a web page"),
)
"""How files begin (regular expressions), what they are, and the name of the format. A PNG with acTL is a film."""


class Kind(NamedTuple):
    """What a file is, and its format in words: text, "PDF"."""

    what: What
    name: str

    def __str__(self) -> str:
        article = "an" if self.what == "archive" else "" if self.what == "sound" else "a"
        return f"{article} {self.what} ({self.name})".strip() if self.name else f"{article} {self.what}"


def names_in(folder: Path) -> str:
    """What a folder holds, for the words about one that lacks what was wanted."""
    return ", ".join(sorted(path.name for path in folder.iterdir())[:LISTED]) or "nothing"


def kind_of(path: Path) -> Kind | None:
    """What a file is; None for one that is none of these. OSError where it cannot be read."""
    with open(path, "rb") as file:
        head = file.read(HEAD)
    for begins, what, name in HEADS:
        if re.match(begins, head, re.DOTALL):
            return Kind(what, name)
    text = codecs.getincrementaldecoder("utf-8")("replace").decode(head)  # a letter that the end cuts is left out
    plain = text and all(one != "\ufffd" and (one.isprintable() or one.isspace()) for one in text)
    return Kind("text", "") if plain else None
