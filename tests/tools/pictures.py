"""docs/pictures/ made anew: `HUGS_CLIPS=FOLDER python -m tests.tools.pictures KITCHEN COURTYARD JUGGLER [NAME ...]`.

Three folders `default` of finished runs, as `make table` leaves them in build/table/NAME/CLIP/; the dance is
FOLDER/motion/jesse_dance.bvh. strip: the pictures at the top of README. report: the top of the kitchen's report. films: four
moments of two people in the kitchen. dance: the film of docs/films.md, whose YAML is taken from there, and its page. examples:
what `examples/*.py` write, of the kitchen and the courtyard. Without a NAME all of them are made.
"""

from __future__ import annotations

import base64
import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import yaml

import hugs
from stages.formats.clip import load_clip
from stages.formats.images import read_image
from tests.docs.documents import Document
from tests.made.browser import LOADED
from tests.made.command import ROOT
from tests.made.devtools import SOFTWARE, Page
from tests.made.examples import example, write_arrays
from tests.tools import gallery, strip

CLIPS = "kitchen", "courtyard", "juggler"
PLACE = ROOT / "docs" / "pictures"
TALL, QUALITY = {"films": 518, "dance": 420, "examples": 240}, 75  # px, of WebP
WINDOW = 800  # px of the page, in which its controls stand in a line
BACK, HALL = 1.0, (560, 594)  # m behind the clip's camera, px
OPEN = "document.body?.matches('.open, .stuck')"
PAUSE = "new Promise(done => setTimeout(done, 3000))"  # until films show a picture
TWO = """
scene: work/kitchen/default
people:
  - {avatar: work/kitchen/default, motion: clip, at: [-0.25, 0]}
  - {avatar: work/courtyard/default, motion: clip, at: [0.45, -0.35]}
camera: still
"""
MOMENTS = {"films": (0.5, 2.0, 3.0, 4.2), "dance": (1.2, 2.5)}  # s of a film
MASKED = 10  # every tenth frame gets a mask
SHOWN = {  # of an example: the function, its arguments, and what is shown of what it writes
    "pose_and_draw": ("main", ("{kitchen}", "pose.png"), ("pose.png",)),
    "camera_path": ("main", ("{kitchen}", "path"), ("path/008.png", "path/015.png")),
    "fit_pose": ("main", ("{kitchen}", "found.png"), ("found.png",)),
    "two_people": ("main", ("{courtyard}", "{kitchen}", "two.png"), ("two.png",)),
    "own_masks": ("write_masks", ("some", "masks"), ("outlines.png",)),
    "train_on_arrays": ("main", ("arrays.npz", "mine"), ("mine/frame.png",)),
}


def main(kitchen: Path, courtyard: Path, juggler: Path, names: Sequence[str]) -> None:
    """Make the pictures of these names."""
    with tempfile.TemporaryDirectory() as place:
        room = Path(place)
        (room / "work").mkdir()
        for clip, run in zip(CLIPS, (kitchen, courtyard, juggler)):
            (room / "work" / clip).symlink_to(run.resolve().parent)
        made: dict[str, Callable[[], None]] = {
            "strip": lambda: strip.main(kitchen, PLACE / "strip.webp"),
            "report": lambda: write(
                "report", screen(kitchen / "report.html", room, (1140, 1250), ["--disable-gpu"], LOADED, PAUSE)
            ),
            "films": lambda: write("films", beside("films", moments(room, "films", TWO))),
            "dance": lambda: write(
                "dance", beside("dance", [*moments(room, "dance", dance(room), page="dance.html"), page(room)])
            ),
            "examples": lambda: write("examples", beside("examples", examples(room))),
        }
        for name in names or made:
            made[name]()
            print(f"{name}.webp, {(PLACE / f'{name}.webp').stat().st_size / 1e3:.0f} kB")


def dance(room: Path) -> str:
    """The YAML of docs/films.md, with what it names beside it."""
    (room / "jesse_dance.bvh").symlink_to(Path(os.environ["HUGS_CLIPS"]).resolve() / "motion" / "jesse_dance.bvh")
    avatar = hugs.load(room / "work" / "kitchen" / "default")
    clip = avatar.cameras[len(avatar.cameras) // 2]
    view, K = np.array(clip.viewmat, float), np.array(clip.K, float)
    view[2, 3] += BACK
    K[:2, 2] = HALL[0] / 2, HALL[1] / 2
    np.savez(room / "hall.npz", viewmats=view[None], Ks=K[None], width=HALL[0], height=HALL[1])
    return shown_film()


def shown_film() -> str:
    """The film of docs/films.md."""
    (found,) = Document("films.md", (ROOT / "docs" / "films.md").read_text(encoding="utf-8")).blocks("yaml")
    return found


def moments(room: Path, name: str, text: str, **out: str) -> list[np.ndarray]:
    """A film's moments that are shown, uint8 [H,W,3], and its other outputs."""
    made = {"stills": {"folder": name, "at": list(MOMENTS[name])}} | out
    (room / f"{name}.yaml").write_text(yaml.safe_dump(yaml.safe_load(text) | {"out": made}))
    hugs.compose(room / f"{name}.yaml", work=room / "work")
    return [read_image(path) for path in sorted((room / name).iterdir())]


def page(room: Path) -> np.ndarray:
    """The film's page at its first moment, as fine as a graphics card draws it."""
    moment = f"hugs.player.set({{position: {MOMENTS['dance'][0]} * hugs.player.motion.fps}})"
    then = f"hugs.player.stage.pace.share = () => 1; {moment}; hugs.player.stage.idle()"
    return screen(room / "dance.html", room, (WINDOW, WINDOW), SOFTWARE, OPEN, then)


def examples(room: Path) -> list[np.ndarray]:
    """What each example writes of the runs in room/work, uint8 [H,W,3]."""
    runs = {clip: room / "work" / clip / "default" for clip in CLIPS}
    write_arrays(room / "arrays.npz", load_clip(runs["kitchen"] / "sfm", runs["kitchen"] / "smpl"), share=3)
    (room / "some").mkdir()
    for frame in sorted((runs["kitchen"] / "frames" / "images").iterdir())[::MASKED]:
        (room / "some" / frame.name).symlink_to(frame)
    with contextlib.chdir(room):
        for name, (function, arguments, _) in SHOWN.items():
            getattr(example(name), function)(*(one.format(**runs) for one in arguments))
    return [read_image(room / path) for *_, paths in SHOWN.values() for path in paths]


def screen(page: Path, room: Path, size: tuple[int, int], flags: list[str], until: str, then: str) -> np.ndarray:
    """A page as Chromium shows it once it is open and the promise `then` is kept, uint8 [H,W,3]."""
    with contextlib.closing(Page(room / f"profile-{page.stem}", size, flags)) as tab:
        tab.open(page, until)
        tab.run(then)
        data = base64.b64decode(tab.ask("Page.captureScreenshot")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


def beside(name: str, pictures: Sequence[np.ndarray]) -> np.ndarray:
    """Pictures in a row, of one height."""
    tall = TALL[name]
    sizes = [(round(one.shape[1] * tall / one.shape[0]), tall) for one in pictures]
    return gallery.beside([cv2.resize(*both, interpolation=cv2.INTER_AREA) for both in zip(pictures, sizes)])


def write(name: str, picture: np.ndarray) -> None:
    """Write a picture uint8 [H,W,3] to docs/pictures."""
    if not cv2.imwrite(str(PLACE / f"{name}.webp"), picture[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        sys.exit(f"cannot write {PLACE / name}.webp")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]), sys.argv[4:])
