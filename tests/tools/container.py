"""Tries Dockerfile without Docker: `python -m tests.tools.container ROOT [--mount PATH ...]`.

In the folder ROOT a fresh Debian is made by debootstrap (Debian's package of that name, root is needed), then each line of
Dockerfile is done in it, in a chroot with namespaces of its own: ENV, USER, WORKDIR, COPY of what git tracks, RUN. At last
`hugs demo --pipeline ci` runs there without a network. --mount PATH or PATH:PLACE shows a file or folder of this machine there,
to be read alone, as certificates or pip's configuration where packages come through a mirror; variables PIP_... are passed on.
--from NUMBER goes on with that step in a ROOT that has the ones before. What it took is printed for each step.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tests.made.command import ROOT as REPOSITORY

SUITES = {"debian:12-slim": "bookworm"}
LAST = "hugs demo --pipeline ci --work /tmp/last"


class Step(NamedTuple):
    """One instruction of a Dockerfile and what it is given."""

    word: str
    rest: str


@dataclass
class State:
    """What earlier instructions set for the next ones."""

    env: dict[str, str] = field(default_factory=dict)
    user: str = "root"
    folder: str = "/"


def steps(text: str) -> Iterator[Step]:
    """The instructions of a Dockerfile, each on one line, without comments."""
    for line in text.splitlines():
        if line.strip() and not line.startswith("#"):
            word, _, rest = line.partition(" ")
            yield Step(word, rest.strip())


def inside(root: Path, state: State, command: str, mounts: dict[Path, str], network: bool = True) -> None:
    """Run a shell command in `root` as the state's user; CalledProcessError if it fails. Its mounts vanish with it."""
    make_places(root, mounts)
    lines = ["set -e", f"mount -t proc proc {root}/proc", f"mount --rbind /dev {root}/dev"]
    for path, place in mounts.items():
        lines += [f"mount --rbind -o ro {shlex.quote(str(path))} {shlex.quote(f'{root}{place}')}"]
    env = (
        state.env
        | {key: value for key, value in os.environ.items() if key.startswith("PIP_")}
        | {"HOME": f"/home/{state.user}"}
    )
    told = " ".join(f"{key}={shlex.quote(value)}" for key, value in env.items())
    work = f"cd {shlex.quote(state.folder)} && {command}"
    who = f"setpriv --reuid {state.user} --regid {state.user} --clear-groups" if state.user != "root" else ""
    lines += [f"exec env -i {told} chroot {root} {who} /bin/sh -ec {shlex.quote(work)}"]
    spaces = ["unshare", "--mount", "--pid", "--fork", "--kill-child", *([] if network else ["--net"])]
    subprocess.run([*spaces, "sh", "-c", "\n".join(lines)], check=True)


def make_places(root: Path, mounts: dict[Path, str]) -> None:
    """Something to mount on for each path."""
    for path, where in mounts.items():
        place = Path(f"{root}{where}")
        if path.is_dir():
            place.mkdir(parents=True, exist_ok=True)
        else:
            place.parent.mkdir(parents=True, exist_ok=True)
            place.touch()


def copy(root: Path, state: State, rest: str) -> None:
    """COPY --chown=USER . TARGET: what git tracks."""
    owner, source, target = rest.split()
    assert owner.startswith("--chown=") and source == "."
    tracked = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    for name in filter(None, tracked.stdout.split("\0")):
        place = Path(f"{root}{target}", name)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(REPOSITORY / name, place)
    inside(root, State(state.env), f"chown -R {owner.removeprefix('--chown=')} {target}", {})


def do(root: Path, state: State, step: Step, mounts: dict[Path, str]) -> None:
    """One instruction."""
    match step.word:
        case "FROM":
            subprocess.run(["debootstrap", "--variant=minbase", SUITES[step.rest], str(root)], check=True)
        case "RUN":
            inside(root, state, step.rest, mounts)
        case "COPY":
            copy(root, state, step.rest)
        case "ENV":
            state.env |= dict(pair.split("=", 1) for pair in shlex.split(step.rest))
        case "USER":
            state.user = step.rest
        case "WORKDIR":
            state.folder = step.rest
        case "ARG" | "ENTRYPOINT":
            pass
        case _:
            raise SystemExit(f"Dockerfile has {step.word}, which this program does not know")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("root", type=Path)
    parser.add_argument("--mount", nargs="*", default=[], metavar="PATH[:PLACE]")
    parser.add_argument("--from", type=int, default=0, dest="first")
    args = parser.parse_args()
    mounts = {Path(path): place or path for path, _, place in (one.partition(":") for one in args.mount)}
    root, mounts, state = args.root.resolve(), {Path("/etc/resolv.conf"): "/etc/resolv.conf"} | mounts, State()
    for number, step in enumerate(steps((REPOSITORY / "Dockerfile").read_text())):
        if number >= args.first or step.word in ("ENV", "USER", "WORKDIR"):
            began = time.perf_counter()
            do(root, state, step, mounts)
            print(f"step {number}, {time.perf_counter() - began:.0f} s: {step.word} {step.rest}", flush=True)
    assert state.user != "root"
    inside(root, state, LAST, {}, network=False)
    print(f"without a network: {LAST}")


if __name__ == "__main__":
    main()
