"""The synthetic clip with known truth. No pipeline names it; `hugs demo` runs it."""

from __future__ import annotations

from stages import contract
from stages.contract import Job


class Params(contract.Params):
    pass


def run(job: Job, params: Params) -> None:
    """Write clip.mp4, and its truth in truth/."""
    from stages.formats.body_model import read_body_model
    from stages.synthetic.clip import make_clip
    from stages.synthetic.files import write_clip

    write_clip(job.out, make_clip(read_body_model(None), seed=job.seed))
