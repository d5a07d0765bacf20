"""How many frames a second a finished person is drawn at, posed anew for each, with its scene and alone, 1280x720.

    python -m tests.benchmarks.render work/kitchen/default [--frames 60] [--device cuda] [--json out.json]

The argument is the folder of a pipeline that has run. Poses and cameras are the clip's, pictures stretched to the size, so
that every pixel has something to show; at rest, the camera is that of the middle frame. A frame is skeleton, skinning and drawing,
no file.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from stages.avatar.drawing.avatar import PosedAvatar
from stages.avatar.drawing.cast import Cast
from stages.avatar.rasterize import Camera, Kept
from tests.benchmarks.host import all_threads, clock, machine, summary, use_threads
from tests.benchmarks.workloads import finished

SIZE = (1280, 720)
WARM_UP = 5  # pictures


def stretched(K: np.ndarray, width: int, height: int) -> np.ndarray:
    """Intrinsics of a picture of SIZE that shows just what one of width x height px shows."""
    return K * [[SIZE[0] / width], [SIZE[1] / height], [1]]


def measure(folder: Path, frames: int, device: str) -> list[dict]:
    """Milliseconds a frame, for each thread count, with and without the scene, lit as the person stands."""
    clip, learned, poses = finished(folder, device)
    order = [i % len(clip.names) for i in range(frames)]
    Ks = [stretched(K, clip.width, clip.height) for K in clip.Ks]
    films = {"person": (None, None)}
    if learned.scene:
        films |= {"person and scene": (learned.scene, None), "camera at rest": (learned.scene, len(clip.names) // 2)}
    rows = []
    for threads in sorted({all_threads(), 1}) if device == "cpu" else [all_threads()]:
        use_threads(threads)
        for name, (scene, rest) in films.items():
            kept = Kept()

            def frame(i: int, scene=scene, rest=rest, kept=kept) -> None:
                who = PosedAvatar.of(learned.avatar, *poses[clip.names[i]])
                view = i if rest is None else rest
                camera = Camera.of(clip.viewmats[view], Ks[view], *SIZE)
                Cast([who], scene, learned.effects).at(0).picture(camera, kept=kept)

            for i in order[:WARM_UP]:
                frame(i)
            count = len(learned.avatar.resting.means) + (len(scene.means) if scene else 0)
            times = summary([clock(lambda i=i: frame(i)) for i in order])
            rows.append({"drawn": name, "gaussians": count, "threads": threads, "ms": times})
    return rows


def main() -> None:
    """Print the table; write it as JSON too."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    host, rows = machine(), measure(asked.folder, asked.frames, asked.device)
    print(f"{host['processor']}, load {host['load'][0]:.1f}; {SIZE[0]}x{SIZE[1]}, median of {asked.frames} frames")
    for row in rows:
        ms = row["ms"]
        print(
            f"{row['drawn']:<18}{row['gaussians']:>9,} Gaussians, {row['threads']} threads: "
            f"{1e3 / ms['median']:>6.1f} frames/s, {ms['median']:.1f} ms [{ms['q1']:.1f}-{ms['q3']:.1f}]"
        )
    if asked.json:
        asked.json.write_text(json.dumps({"machine": host, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
