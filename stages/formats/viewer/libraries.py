"""The libraries of the page, as npm serves them, gzipped one by one; tests pin the digest of each."""

from __future__ import annotations

import base64
from pathlib import Path

ROOM = Path(__file__).parent / "libraries"
FILES = {
    "three-core": "three.core.js.gz",
    "three": "three.module.js.gz",
    "three/addons/controls/OrbitControls.js": "OrbitControls.js.gz",
    "three/addons/postprocessing/Pass.js": "Pass.js.gz",
    "@sparkjsdev/spark": "spark.module.min.js.gz",
}
"""The name by which modules import a library -> its file: three 0.187.0 and @sparkjsdev/spark 2.2.0."""
LICENCES = {"three.js 0.187.0": "three.LICENSE", "Spark 2.2.0": "spark.LICENSE"}


def packed() -> dict[str, str]:
    """Each library by the name that modules import, gzipped, base64."""
    return {name: base64.b64encode((ROOM / file).read_bytes()).decode() for name, file in FILES.items()}


def licences() -> str:
    """The licence texts."""
    return "\n\n".join(f"{name}\n{(ROOM / file).read_text(encoding='utf-8')}" for name, file in LICENCES.items())
