"""What the HUGS paper reports on the sequences of its data sets, to stand beside our numbers.

Source: Kocabas et al., HUGS: Human Gaussian Splats, CVPR 2024, arXiv 2311.17910, the tables on NeuMan and ZJU-MoCap.
"""

from __future__ import annotations

import re

NEUMAN = {
    "seattle": {"full": (25.94, 0.85, 0.13), "person_crop": (19.06, 0.67, 0.15)},
    "citron": {"full": (25.54, 0.86, 0.15), "person_crop": (19.16, 0.71, 0.16)},
    "parkinglot": {"full": (26.86, 0.85, 0.22), "person_crop": (19.44, 0.73, 0.17)},
    "bike": {"full": (25.46, 0.84, 0.13), "person_crop": (19.48, 0.67, 0.18)},
    "jogging": {"full": (23.75, 0.78, 0.22), "person_crop": (17.45, 0.59, 0.27)},
    "lab": {"full": (26.00, 0.92, 0.09), "person_crop": (18.79, 0.76, 0.18)},
}
"""Sequence -> our region that is measured as theirs -> PSNR in dB, SSIM, LPIPS."""
ZJU = {"377": 30.80, "386": 34.11, "387": 29.29, "392": 31.36, "393": 29.80, "394": 30.54}
"""Subject -> PSNR in dB."""
COMPARED = {
    "neuman": "The same frames are measured. Ours are psnr_per_channel, ssim and lpips_legacy of metrics.json, as the "
    "paper's code computes them, of held-out frames with the data set's poses corrected as their neighbours were; our "
    "box of the person has one row and one column more. With 3 to 10 frames differences below 0.3 dB are noise.",
    "zju": "The paper says that camera 1 is trained on and the other 22 are measured, not at which moments, at what "
    "resolution, or in what crop; its code cuts both pictures out by the mask. Ours is psnr_per_channel of masked_full "
    "in metrics.json: the order of magnitude compares, not the last decibel.",
}


def published(dataset: str, sequence: str) -> dict[str, tuple[float | None, ...]]:
    """Region of metrics.json -> (PSNR, SSIM, LPIPS) of the paper, None where it has none; empty for other sequences."""
    name = sequence.lower()
    if dataset == "neuman":
        return dict(NEUMAN.get(name.replace("_", ""), {}))
    found = re.search(r"\d{3}", name)
    known = found and ZJU.get(found[0])
    return {"masked_full": (known, None, None)} if dataset == "zju" and known else {}
