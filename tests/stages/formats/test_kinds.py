"""What a file is by how it begins."""

from __future__ import annotations

import pytest

from stages.formats.kinds import HEAD, LISTED, kind_of, names_in

BEGINS = {
    b"\xff\xd8\xff\xe0": "a picture (JPEG)",
    b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR": "a picture (PNG)",
    b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR acTL": "None",  # a film of pictures
    b"\0\0\0\x18ftypheic": "a picture (HEIF)",
    b"\0\0\0\x18ftypisom": "None",
    b"RIFF\0\0\0\0WAVE": "sound (WAV)",
    b"RIFF\0\0\0\0AVI ": "None",
    b"PK\3\4": "an archive (zip)",
    b"#EXTM3U\n": "a playlist (names of films)",
    b'<?xml version="1.0"?>\n<MPD>': "a playlist (names of films)",
    b"\n<HTML>": "a text (a web page)",
    "Zürich\n".encode() * 200: "a text",  # the end of what is read cuts a letter
    b"x" * (HEAD - 1) + "é".encode(): "a text",
    b"\x80\4\x95": "None",
    b"": "None",
}


@pytest.mark.parametrize("begins", BEGINS)
def test_files_are_known_by_how_they_begin(tmp_path, begins):
    (tmp_path / "file").write_bytes(begins)
    assert str(kind_of(tmp_path / "file")) == BEGINS[begins]


def test_what_a_folder_holds_is_named_in_order_and_not_all_of_much(tmp_path):
    assert names_in(tmp_path) == "nothing"
    for number in range(LISTED + 3):
        (tmp_path / f"{number:02d}.png").touch()
    assert names_in(tmp_path).split(", ") == [f"{number:02d}.png" for number in range(LISTED)]
