"""The commands of ffmpeg that hints print, run by the libraries that PyAV brings: the program itself need not be there."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import av
from av.filter import Graph


def run(said: str, folder: Path) -> Path:
    """Run the command in backticks in what was said, in the folder of its film; the film that it writes, or its first picture."""
    program, *words = shlex.split(re.search(r"`(ffmpeg [^`]+)`", said)[1])
    options, out = dict(zip(words[:-1:2], words[1:-1:2], strict=True)), folder / words[-1]
    assert program == "ffmpeg" and options.keys() <= {"-framerate", "-i", "-vf", "-crf", "-fps_mode"}
    reading = {"framerate": options["-framerate"]} if "-framerate" in options else {}
    with av.open(str(folder / options["-i"]), options=reading) as film:
        rate, frames = film.streams.video[0].average_rate, filtered(film.decode(video=0), options.get("-vf", "null"))
        if "%" in out.name:
            assert options["-fps_mode"] == "passthrough", "else frames are doubled or dropped"
            out.parent.mkdir(exist_ok=True)
            for number, frame in enumerate(frames, start=1):
                frame.to_image().save(str(out) % number)
            return Path(str(out) % 1)
        with av.open(str(out), "w") as made:
            stream = None
            for number, frame in enumerate(frames):
                if stream is None:
                    stream = made.add_stream("libx264", rate=rate, options={"crf": options.get("-crf", "23")})
                    stream.width, stream.height = frame.width, frame.height
                frame.pts, frame.time_base = number, 1 / rate
                made.mux(stream.encode(frame.reformat(format="yuv420p")))
            made.mux(stream.encode(None))
    return out


def filtered(frames: Iterator[av.VideoFrame], chain: str) -> Iterator[av.VideoFrame]:
    """Frames through a chain of filters, which begins anew where they change their size."""
    graph, size = None, None
    for frame in frames:
        if size != (frame.width, frame.height):
            graph, size = Graph(), (frame.width, frame.height)
            nodes = [
                graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base)
            ]
            nodes += [graph.add(name, given) for name, _, given in (one.partition("=") for one in chain.split(","))]
            graph.link_nodes(*nodes, graph.add("buffersink")).configure()
        graph.push(frame)
        yield from drawn(graph)
    graph.push(None)
    yield from drawn(graph)


def drawn(graph: Graph) -> Iterator[av.VideoFrame]:
    """What has come out of a graph."""
    while True:
        try:
            yield graph.pull()
        except (av.error.BlockingIOError, av.error.EOFError):
            return
