"""Decodes a video and picks sharp frames, evenly spread in time."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from shutil import rmtree
from typing import TYPE_CHECKING, Any

from pydantic import Field

from stages import contract
from stages.contract import Job, StageError
from stages.formats.facts import write_facts

if TYPE_CHECKING:
    import numpy as np

    from stages.formats.film_times import FilmTimes
    from stages.formats.video import VideoInfo

LEAST = 8
"""Frames without which neither cameras nor a person can be had."""
SCORE_SIDE = 480
"""Longer side in px at which sharpness is compared, so that it does not depend on the resolution."""
CENTER_PULL = 0.3
"""Share of its sharpness that a frame at the edge of its time slot is marked down, to spread the frames evenly."""
SAME = 4.0
"""Grey levels: two frames whose blurred thumbnails differ by less everywhere are the same picture."""
BLURRED = 0.2
"""A frame with less than this share of its neighbours' median sharpness is blurred (or a fade) and dropped."""
LOOK, SIDE, LIKE, RESTS = 15, 320, 4, 0.5
"""A camera stands if from the first frame to this one, at this width in px, fewer grey levels than these change in at least this
share of the picture: 0.83 to 0.92 of five films here, 0.11 to 0.22 of three whose camera moves."""
NEIGHBOURS = 4
"""Picked frames on each side that a frame's sharpness is compared with."""


class Params(contract.Params):
    """Which frames to take."""

    count: int = Field(80, ge=LEAST)
    """Frames to pick. More frames cost time in every later stage."""
    max_side: int = Field(960, ge=64)
    """Longer side of the pictures in px; larger videos are shrunk, smaller ones left as they are."""
    folder_fps: float = Field(10.0, gt=0)
    """Pictures a second, if a folder of pictures is given instead of a video."""


def check(params: Params, *, video: Path) -> None:
    """See `contract.StageModule`: a film or a folder of pictures, with enough of them."""
    check_video(Job(Path()), described(params, video))


def sizes(params: Params, video: Path) -> tuple[float, float]:
    """How many frames, of how many pixels each, will be picked, by the header of the film; without one, 16:9 is assumed."""
    from stages.formats.video import open_video

    try:
        container, stream = open_video(video)
    except (StageError, OSError):  # `check` says so; pictures in a folder have no header
        return params.count, params.max_side**2 * 9 / 16
    with container:
        smaller = min(1.0, params.max_side / max(stream.width, stream.height, 1))
        frames = min(params.count, stream.frames) if stream.frames else params.count
        return frames, smaller**2 * stream.width * stream.height


def moves(video: Path) -> bool:
    """Whether the camera seems to move, by the first half second; True where it cannot be read, and of pictures in a folder."""
    import numpy as np

    from stages.formats.video import decode_frames

    shown: list[np.ndarray] = []
    try:
        for frame in islice(decode_frames(video), 0, LOOK + 1, LOOK):
            height = round(SIDE * frame.height / frame.width)
            shown.append(frame.reformat(width=SIDE, height=height, format="gray").to_ndarray().astype(float))
    except (StageError, OSError):  # `check` says so
        return True
    return len(shown) < 2 or bool((np.abs(shown[0] - shown[-1]) < LIKE).mean() < RESTS)


def run(job: Job, params: Params, *, video: Path) -> None:
    """Write images/%06d.png (numbered by the frame in the video) and frames.json.

    Time is cut into `count` equal slots; of each the sharpest frame is kept, then copies of the frame before and
    blurred ones are dropped. One pass, one frame in memory. Raises StageError for a path that is missing, not a video,
    cut short, or has too few frames.
    """
    from stages.formats.film_times import FilmTimes, TimesFall
    from stages.formats.told_focal import told_focal

    info, pace = described(params, video), params.folder_fps if video.is_dir() else 1.0
    check_video(job, info)
    folder = job.out / "images"
    times = FilmTimes(info.times, info.duration_s * pace, params.count)
    try:
        taken = pick(job, params, video, info, times, pace)
    except TimesFall:
        job.warn(
            f"the times of the film's frames run backwards: frames are counted instead, {info.counted:.3g} a second"
        )
        rmtree(folder)
        info = replace(info, fps=info.counted, duration_s=info.frames / info.counted)
        times = FilmTimes([i / info.fps for i in range(info.frames)], info.duration_s, params.count)
        taken = pick(job, params, video, info, times, None)
    picker, decoded, width, height = taken
    if not times.good.all():
        info = replace(info, fps=times.good.sum() / times.duration, duration_s=times.duration)
    check_decoded(job, info, decoded)
    frames, blurred = without_blurred(picker.kept)
    for frame in blurred:
        (folder / f"{frame['name']}.png").unlink()
    if len(frames) < LEAST:
        raise StageError(
            f"{Path(info.path).name} has only {len(frames)} usable frames",
            "film longer, with the phone or the person moving and the picture sharp",
            [f"{decoded} decoded, {picker.copies} copies of the frame before, {len(blurred)} blurred"],
        )
    facts = {
        "video": film_facts(info, decoded),
        "width": width,
        "height": height,
        "frames": with_sources(frames, video),
        "dropped": {
            "undecodable": max(info.frames - decoded, 0),
            "not_sharpest": decoded - len(picker.kept) - picker.copies,
            "copies": picker.copies,
            "blurred": len(blurred),
        },
    }
    if told := told_focal(video, width, height):
        facts["focal"] = told.model_dump()
    write_facts(job.out / "frames.json", facts)
    job.note(f"{len(frames)} of {decoded} frames, {width}x{height}")
    if video.is_dir() and pace == Params.model_fields["folder_fps"].default:
        job.note(f"a folder has no frame rate: {pace:g} pictures a second assumed (`--set frames.folder_fps=30`)")
    if picker.copies or blurred:
        job.note(f"dropped {picker.copies} copies and {len(blurred)} blurred frames")


def described(params: Params, video: Path) -> VideoInfo:
    """What the clip says of itself; a folder of pictures does not say how fast they follow."""
    from stages.formats.video import probe

    info, pace = probe(video), params.folder_fps if video.is_dir() else 1.0
    return replace(info, fps=info.fps * pace, duration_s=info.duration_s / pace)


def pick(
    job: Job, params: Params, video: Path, info: VideoInfo, times: FilmTimes, pace: float | None
) -> tuple[Picker, int, int, int]:
    """Write the pictures of the sharpest frames; what was picked, how many frames decode, and the pictures' size.

    `times` in units of 1/`pace` s; None: whatever the film says, they are counted. Raises TimesFall.
    """
    from stages.formats.images import shrink, write_image
    from stages.formats.video import decode

    folder, picker, flags = job.out / "images", Picker(times.slots), Counter[str]()
    folder.mkdir(exist_ok=True)
    decoded, small = 0, None
    for index, time, pixels in decode(video, flags):
        decoded += 1
        spot = times.at(time if pace else float("nan"))
        if spot is not None:
            small = shrink(pixels, params.max_side)
            for picked in picker.offer(index, spot[0] / (pace or 1), spot[1], small):
                write_image(folder / f"{picked.name}.png", picked.pixels)
        if decoded % 10 == 0:
            job.progress(decoded, max(info.frames, decoded))
    for picked in picker.close():
        write_image(folder / f"{picked.name}.png", picked.pixels)
    for said in times.said:
        job.warn(said)
    if flags["interlaced"]:
        make = f"`ffmpeg -i {Path(info.path).name} -vf bwdif=send_frame -crf 16 {Path(info.path).stem}-whole.mp4`"
        job.warn(
            f"{flags['interlaced']} of {decoded} frames are interlaced, with combs where something moves: {make} removes them"
        )
    height, width = (0, 0) if small is None else small.shape[:2]
    return picker, decoded, width, height


def check_video(job: Job, info: VideoInfo) -> None:
    """StageError for a video that says it has too few frames; a warning for high dynamic range, a note for oblong pixels."""
    for said in info.notes:
        job.note(said)
    for said in info.doubts:
        job.warn(said)
    if info.transfer != "sdr":
        make = "zscale=t=linear:npl=100,tonemap=hable,zscale=p=bt709:t=bt709:m=bt709:r=tv,format=yuv420p"
        job.warn(
            f"the video is {info.transfer} (high dynamic range), decoded without tone mapping: colours look flat; "
            f"`ffmpeg -i {Path(info.path).name} -vf {make} sdr.mp4` converts it"
        )
    if info.pixel != 1:
        job.note(
            f"the video's pixels are {info.pixel:.3g} times as wide as high: made square, {info.width}x{info.height}"
        )
    if info.frames < LEAST:
        raise StageError(
            f"{Path(info.path).name} has only {info.frames} frame{'s' * (info.frames != 1)}",
            "film the person for some seconds, walking around them or with the phone moving",
            [f"at least {LEAST} are needed"],
        )


def check_decoded(job: Job, info: VideoInfo, decoded: int) -> None:
    """StageError if too few of the promised frames could be decoded, a warning if some are missing."""
    from stages.formats.whole_clip import DECODED_SHARE

    if decoded < max(LEAST, DECODED_SHARE * info.frames):
        raise StageError(
            f"only {decoded} of {info.frames} frames of {Path(info.path).name} could be decoded",
            "the file is damaged or cut short; copy or export it again",
        )
    if decoded < info.frames:
        job.warn(
            f"only {decoded} of {info.frames} frames could be decoded; the file is damaged or cut short: copy it again"
        )


def film_facts(info: VideoInfo, decoded: int) -> dict[str, Any]:
    """What frames.json says of the film, of which so many frames were decoded."""
    from stages.formats.frame_names import plain

    numbers = {"fps": round(info.fps, 3), "frames": decoded, "duration_s": round(info.duration_s, 4)}
    turned = {"rotation": info.rotation} | ({"mirrored": True} if info.mirrored else {})
    return {"path": plain(Path(info.path).name), "width": info.width, "height": info.height} | numbers | turned


def with_sources(frames: list[dict[str, Any]], video: Path) -> list[dict[str, Any]]:
    """The frames, with the picture's own name as `source` where a folder of pictures was given."""
    from stages.formats.frame_names import plain
    from stages.formats.pictures import picture_files

    if not Path(video).is_dir():
        return frames
    names = [plain(file.stem) for file in picture_files(video)]
    return [{**frame, "source": names[frame["index"]]} for frame in frames]


@dataclass(frozen=True)
class Candidate:
    """A frame of the video: its time in s, its sharpness, its score in its slot, pixels uint8 [H,W,3]."""

    index: int
    time_s: float
    sharpness: float
    score: float
    pixels: np.ndarray

    @property
    def name(self) -> str:
        return f"{self.index:06d}"


class Picker:
    """Keeps the sharpest frame of each of so many equal time slots of a stream."""

    def __init__(self, slots: int):
        self.slots, self.slot = slots, 0
        self.best: Candidate | None = None
        self.last: np.ndarray | None = None
        self.kept: list[dict[str, Any]] = []
        self.copies = 0

    def offer(self, index: int, time_s: float, place: float, pixels: np.ndarray) -> Iterator[Candidate]:
        """Take the next frame, whose place is 0 to `slots`; yields the frame of a slot that has just ended."""
        slot = min(int(place + 1e-6), self.slots - 1)
        if slot != self.slot:
            yield from self.close()
            self.slot = slot
        sharp = sharpness(pixels)
        score = sharp * (1 - CENTER_PULL * min(abs(place - slot - 0.5) * 2, 1) ** 2)
        if self.best is None or score > self.best.score:
            self.best = Candidate(index, time_s, sharp, score, pixels)

    def close(self) -> Iterator[Candidate]:
        """End the slot: yields its best frame unless it is a copy of the one kept before."""
        best, self.best = self.best, None
        if best is None:
            return
        thumb = thumbnail(best.pixels)
        if self.last is not None and abs(thumb - self.last).max() < SAME:
            self.copies += 1
            return
        self.last = thumb
        times = {"time_s": round(best.time_s, 6), "sharpness": round(best.sharpness, 3)}
        self.kept.append({"name": best.name, "index": best.index} | times)
        yield best


def without_blurred(frames: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Split frames into those about as sharp as their neighbours and those far below them."""
    import numpy as np

    sharp = np.array([frame["sharpness"] for frame in frames])
    usual = [np.median(sharp[max(i - NEIGHBOURS, 0) : i + NEIGHBOURS + 1]) for i in range(len(sharp))]
    good = sharp >= BLURRED * np.array(usual)
    flat = sharp < 1e-3 * max(np.median(sharp), 1e-9)
    pairs = list(zip(frames, good & ~flat, strict=True))
    return [frame for frame, keep in pairs if keep], [frame for frame, keep in pairs if not keep]


def sharpness(pixels: np.ndarray) -> float:
    """Variance of the Laplacian of the grey picture at a fixed scale (Pech-Pacheco et al. 2000)."""
    import cv2

    from stages.formats.images import shrink

    grey = cv2.cvtColor(shrink(pixels, SCORE_SIDE), cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def thumbnail(pixels: np.ndarray) -> np.ndarray:
    """A small blurred grey picture, float32, in which compression noise is gone and a moving hand is not."""
    import cv2

    from stages.formats.images import shrink

    grey = cv2.cvtColor(shrink(pixels, 160), cv2.COLOR_RGB2GRAY)
    return cv2.GaussianBlur(grey, (5, 5), 0).astype("float32")
