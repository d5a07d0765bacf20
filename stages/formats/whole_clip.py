"""A clip before any of its frames is picked: what files that come with it can be of."""

from __future__ import annotations

from pathlib import Path

from stages.contract import StageError
from stages.formats.facts import Frame, Listing, Video
from stages.formats.frame_names import plain
from stages.formats.pictures import picture_files
from stages.formats.video import probe

DECODED_SHARE = 0.5
"""A film of which less than this decodes is refused; less than all is reported."""


def whole_clip(video: Path) -> Listing | None:
    """All frames that a film, or a folder of pictures, can have by what it says of itself, at its own size; None for the folder
    of a data set. StageError as `probe`."""
    video = Path(video)
    try:
        info = probe(video)
    except StageError:
        if video.is_dir():
            return None
        raise
    total = max(info.frames, len(info.times))
    names = [plain(file.stem) for file in picture_files(video)] if video.is_dir() else [""] * total
    frames = tuple(Frame(name=f"{i:06d}", index=i, time_s=0.0, source=name) for i, name in enumerate(names))
    film = Video(path=plain(video.name), frames=total)
    return Listing(width=info.width, height=info.height, video=film, frames=frames)
