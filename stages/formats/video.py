"""Video files, through PyAV: frames upright with their own times, and H.264 that a browser plays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

from stages.contract import StageError, whole
from stages.formats.film_pixels import QUARTER, rgb_of, turn_of
from stages.formats.images import first_line, read_image
from stages.formats.kinds import kind_of
from stages.formats.pictures import pictures_in

HIGH_DYNAMIC_RANGE = {16: "PQ", 18: "HLG"}  # ITU-T H.273 transfer characteristics
BT709 = 1  # H.273 number of BT.709 for matrix, primaries and transfer
SQUARE, LONGEST = 0.01, 4.0  # of a pixel's width over its height: nearer to 1 is square, beyond is no film's
THREADS = 2
REPEATABLE = "mbtree=0"
"""Of x264: the same pictures give the same bytes. Its macroblock tree reads memory that nobody wrote, at widths such as 480."""
LISTS = {"concat", "hls", "applehttp", "dash", "imf"}  # formats that name other files, whose changes nobody would see
LIST = "give the film itself; `ffmpeg -i LIST -c copy film.mp4` makes one of several"
INSTEAD = {
    "picture": "give a video, or the folder of all pictures of the clip",
    "sound": "give the video that it belongs to",
    "archive": "unpack it, and give the film or the folder of pictures that is in it",
    "text": "give the film itself; where it was downloaded, a page about it may have been saved in its place",
}
"""What to give in place of a file of another kind."""
AGAIN = "the file is damaged or its codec unknown; export it again as H.264"


@dataclass(frozen=True)
class VideoInfo:
    """What a video says of itself, before decoding; width and height are upright, `frames` as declared or counted."""

    path: str
    width: int
    height: int
    fps: float
    frames: int
    duration_s: float
    rotation: int
    """Degrees counter-clockwise that put the stored picture upright: 0, 90, 180 or 270."""
    transfer: str
    """'sdr', 'PQ' or 'HLG'."""
    pixel: float = 1.0
    """Width over height of a stored pixel; where it is not 1, pictures are widened or narrowed until it is."""
    mirrored: bool = False
    """Left and right are exchanged after the turn."""
    times: tuple[float, ...] = ()
    """When pictures are shown, s from the first that decodes, in order; those that the file does not tell lack."""
    counted: float = 1.0
    """Frames a second where their times cannot be used."""
    notes: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()


def open_video(path: Path) -> tuple[av.container.InputContainer, av.video.stream.VideoStream]:
    """Open a video's container and its film; StageError for a file without one, or a list of films.

    Of several the one with the largest pictures is taken, no cover or still.
    """
    path = Path(path)
    if not path.exists():
        raise StageError(f"no video at {path}", "check the path")
    if path.stat().st_size == 0:
        raise StageError(f"{path} is empty", "copy the video again")
    kind = kind_of(path)
    if kind and kind.what == "playlist":
        raise StageError(f"{path} is a list of films", LIST, [f"it is {kind}"])
    if kind and kind.what != "text":
        raise StageError(f"{path} is not a video but {kind}", INSTEAD[kind.what])
    try:
        container = av.open(str(path), metadata_errors="replace")
    except av.error.FFmpegError as error:
        size = f"{path.stat().st_size} bytes; {first_line(error.strerror or str(error))}"
        cause = "cut short (its index stands at the end and is missing)" if is_mp4(path) else "not a video"
        cause += f" but {kind}" if kind else ""
        hint = INSTEAD["text"] if kind else "copy or export the video again (MP4, MOV, MKV, WebM)"
        raise StageError(f"{path} is {cause}", hint, [size]) from error
    if not container.streams.video or container.format.name in ("tty", "png_pipe", "jpeg_pipe", "image2"):
        kinds = ", ".join(sorted({stream.type for stream in container.streams})) or "no"
        container.close()
        found = f"{path.name} has {kinds} streams, read as {container.format.long_name}"
        raise StageError(f"{path} is not a video", "give a video file or a folder of pictures", [found])
    if LISTS & set(container.format.name.split(",")):
        container.close()
        raise StageError(f"{path} is a list of films", LIST, [f"read as {container.format.long_name}"])
    stream = max(container.streams.video, key=_is_film)
    stream.thread_type, stream.thread_count = "AUTO", THREADS
    return container, stream


def _is_film(stream: av.video.stream.VideoStream) -> tuple[bool, int]:
    """What says that a stream is the film: it is no cover, and its pictures are large."""
    still = getattr(stream.disposition, "name", None) in ("attached_pic", "timed_thumbnails") or stream.frames == 1
    return not still, stream.width * stream.height


def is_mp4(path: Path) -> bool:
    """True if the file begins as MP4 or MOV does."""
    with open(path, "rb") as file:
        return file.read(12)[4:8] in (b"ftyp", b"moov", b"mdat", b"wide")


def probe(path: Path) -> VideoInfo:
    """Read what a video, or a folder of pictures, says of itself; walks its packets but decodes only one frame.

    Raises StageError for a path that is missing, empty, not a video, or without a single frame.
    """
    if Path(path).is_dir():
        inside = pictures_in(path)
        height, width = read_image(inside.files[0]).shape[:2]
        size, steps = (width, height), tuple(inside.steps.tolist())
        notes, doubts = tuple(inside.notes), tuple(inside.doubts)
        return VideoInfo(
            str(path), *size, 1.0, len(steps), steps[-1] + 1, 0, "sdr", times=steps, notes=notes, doubts=doubts
        )
    container, stream = open_video(path)
    with container:
        base, average = stream.time_base, stream.average_rate
        declared, pixel, tracks = declared_frames(stream), pixel_shape(stream), container.streams.video
        others = ", ".join(f"{one.width}x{one.height} {one.name}" for one in tracks if one is not stream)
        chosen = (f"of {len(tracks)} video tracks {stream.width}x{stream.height} {stream.name} is taken, not {others}",)
        try:
            found = [packet.pts for packet in container.demux(stream) if packet.size and not packet.is_discard]
        except av.error.FFmpegError as error:
            raise StageError(f"{path} cannot be read to its end", AGAIN, [first_line(str(error))]) from error
        kind = container.format.long_name
    times = sorted(time for time in found if time is not None)
    if found and not times and not declared:
        name = Path(path)
        hint = (
            f"give it times, with its own frames a second: `ffmpeg -framerate 30 -i {name} {name.with_suffix('.mp4')}`"
        )
        raise StageError(f"{path} is {kind}: pictures without times", hint, [f"{len(found)} packets, none with a time"])
    first = next(decode_frames(path), None)
    if first is None:
        facts = [f"{len(found)} packets, {declared or 'unknown'} frames declared"]
        raise StageError(f"no frame of {path} can be decoded", AGAIN, facts)
    rotation, mirrored = turn_of(first)
    wide = round(first.width * pixel)
    width, height = (wide, first.height) if rotation % 2 == 0 else (first.height, wide)
    start = first.pts if first.pts is not None else times[0] if times else 0
    shown = tuple(float((time - start) * base) for time in times) if base else ()
    span = float((times[-1] - times[0]) * base) if shown and base else 0.0
    rate = (len(times) - 1) / span if span > 0 else float(average or 0)
    transfer = HIGH_DYNAMIC_RANGE.get(int(first.color_trc), "sdr")
    frames = declared or len(times)
    duration = span + (1 / rate if rate > 0 else 0.0)
    numbers = (rate, frames, duration, rotation * QUARTER)
    counted, notes = float(average or rate), chosen if others else ()
    return VideoInfo(str(path), width, height, *numbers, transfer, pixel, mirrored, shown, counted, notes)


def declared_frames(stream: av.video.stream.VideoStream) -> int:
    """Frames that a video's header promises, 0 if none; in MP4 and MOV without those that its edit list cuts away."""
    index = getattr(stream, "index_entries", ())  # older versions of PyAV have none
    if not stream.frames or "mov" not in stream.container.format.name.split(",") or not len(index):
        return stream.frames
    return sum(not entry.is_discard for entry in index)


def pixel_shape(stream: av.video.stream.VideoStream) -> float:
    """Width over height of a video's stored pixels, 1 where it does not say: 4/3 in HDV of 1440x1080."""
    shape = float(stream.sample_aspect_ratio or 1)
    return shape if abs(shape - 1) > SQUARE and 1 / LONGEST <= shape <= LONGEST else 1.0


def decode_frames(path: Path) -> Iterator[av.VideoFrame]:
    """Every frame that decodes, in order; damaged packets and frames marked corrupt are left out."""
    container, stream = open_video(path)
    with container:
        packets = container.demux(stream)
        while True:
            try:
                packet = next(packets, None)
                frames = [] if packet is None else packet.decode()
            except (av.error.InvalidDataError, av.error.EOFError):
                continue
            except av.error.FFmpegError as error:
                raise StageError(f"{path} cannot be decoded", AGAIN, [first_line(str(error))]) from error
            if packet is None:
                return
            yield from (frame for frame in frames if not frame.is_corrupt)


def decode(path: Path, flags: Counter[str] | None = None) -> Iterator[tuple[int, float, np.ndarray]]:
    """Yield (index, time in seconds from the first frame, uint8 [H,W,3] upright) of a video or a folder of pictures.

    Pixels of a video that are not square are made so, at the height that is stored. Frames that do not decode are left out:
    compare the count with `probe`. A time that is not told is NaN; a folder gives one picture a second, and waits where
    numbers lack. `flags` counts frames that are interlaced.
    Raises StageError as `probe` does, and where pictures differ in size.
    """
    size = None
    if Path(path).is_dir():
        inside = pictures_in(path)
        for index, (file, step) in enumerate(zip(inside.files, inside.steps.tolist())):
            picture = read_image(file)
            size = size or picture.shape
            if picture.shape != size:
                facts = [f"first {size[1]}x{size[0]}, {file.name} {picture.shape[1]}x{picture.shape[0]}"]
                raise StageError(f"pictures of different sizes in {path}", "give pictures of one camera", facts)
            yield index, step, picture
        return
    start, (container, stream) = None, open_video(path)
    with container:
        pixel = pixel_shape(stream)
    for index, frame in enumerate(decode_frames(path)):
        time = frame.time if frame.time is not None else np.nan
        start = time if start is None else start
        turns, mirrored = turn_of(frame)
        upright = np.rot90(rgb_of(frame, round(frame.width * pixel)), turns)
        upright = upright[:, ::-1] if mirrored else upright
        if flags is not None:
            flags["interlaced"] += frame.interlaced_frame
        size = size or upright.shape
        if upright.shape != size:
            facts = [f"first {size[1]}x{size[0]}, from {time - start:.1f} s on {upright.shape[1]}x{upright.shape[0]}"]
            hint = f"make them equal: `ffmpeg -i {Path(path).name} -vf scale={size[1]}:{size[0]} equal.mp4`; or cut it there"
            raise StageError(f"the pictures of {path} change their size", hint, facts)
        yield index, time - start, np.ascontiguousarray(upright)


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float, crf: int = 18) -> None:
    """Write uint8 [H,W,3] frames as H.264 yuv420p BT.709 MP4 that starts at once in a browser.

    An odd width or height gets its last column or row repeated. Raises ValueError without frames or with mixed sizes.
    """
    options = {"crf": str(crf), "preset": "fast", "x264-params": REPEATABLE}
    with whole(Path(path)) as part, av.open(str(part), "w", format="mp4", options={"movflags": "+faststart"}) as film:
        _encode(film, _alike(frames, 3), fps, ("libx264", "rgb24", "yuv420p"), options)


def write_alpha_video(path: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write uint8 [H,W,4] frames, alpha not multiplied into colour, as ProRes 4444 in MOV, which editors read."""
    options = {"profile": "4444", "alpha_bits": "16", "vendor": "apl0"}
    with whole(Path(path)) as part, av.open(str(part), "w", format="mov") as film:
        _encode(film, _alike(frames, 4), fps, ("prores_ks", "rgba", "yuva444p10le"), options)


def join_videos(path: Path, parts: Sequence[Path], fps: float) -> None:
    """Write films of one coding, size and rate, one after the other, as one, without coding anything again."""
    kind = "mov" if Path(path).suffix.lower() == ".mov" else "mp4"
    options = {"movflags": "+faststart"} if kind == "mp4" else {}
    with whole(Path(path)) as part, av.open(str(part), "w", format=kind, options=options) as out:
        _join(out, parts, fps)


def _encode(
    container: av.container.OutputContainer,
    frames: Iterable[np.ndarray],
    fps: float,
    kinds: tuple[str, str, str],
    options: dict[str, str],
) -> None:
    """Encode frames by a codec, from the format of their pixels to that of the film's; even in size."""
    codec, given, kept = kinds
    stream: Any = None
    for frame in frames:
        if stream is None:
            stream = _stream(container, codec, frame, fps)
            stream.pix_fmt, stream.options = kept, options
        even = np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge")
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format=given)
        container.mux(stream.encode(picture.reformat(format=kept, dst_colorspace="ITU709")))
    if stream is None:
        raise ValueError("a video needs at least one frame")
    container.mux(stream.encode(None))


def _alike(frames: Iterable[np.ndarray], channels: int) -> Iterator[np.ndarray]:
    size = None
    for frame in frames:
        size = size or (*frame.shape[:2], channels)
        if frame.shape != size or frame.dtype != np.uint8:
            raise ValueError(f"frames are uint8 of one size {size}, not {frame.dtype} {frame.shape}")
        yield frame


def _stream(container: av.container.OutputContainer, codec: str, frame: np.ndarray, fps: float) -> Any:
    """A stream for pictures of a frame's size, made even."""
    stream: Any = container.add_stream(codec, rate=Fraction(fps).limit_denominator(1001))
    height, width = frame.shape[:2]
    stream.width, stream.height = width + width % 2, height + height % 2
    context = stream.codec_context
    context.colorspace = context.color_primaries = context.color_trc = BT709
    context.color_range, context.thread_count = 1, THREADS  # 1: studio range
    return stream


def _join(out: av.container.OutputContainer, parts: Sequence[Path], fps: float) -> None:
    stream: Any = None
    begin = Fraction(0)  # s
    for part in parts:
        with av.open(str(part)) as film:
            own: Any = film.streams.video[0]
            stream = stream or out.add_stream_from_template(own)
            shift, count = round(begin / own.time_base), 0
            for packet in film.demux(own):
                if packet.dts is None or packet.pts is None:  # the end
                    continue
                packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                packet.stream, count = stream, count + 1
                out.mux(packet)
            begin += count / Fraction(fps).limit_denominator(1001)
