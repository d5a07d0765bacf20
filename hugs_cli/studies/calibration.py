"""Measured times that plans are built on, beside those in times.py. Only forecasts depend on them, never a result.

Stages give their own cost after training, see `cost` in stages/train.py, stages/render.py and stages/evaluate.py.
"""

LEAST = 250
"""Steps of a training that takes as long as the shortest one, with what it times, and the least that comes after it."""

LEVEL_TIMES: dict[str, dict[tuple[object, ...], float]] = {
    "steps": {(0.25,): 0.25, (0.5,): 0.5, (2,): 2.0},
    "half": {(0.0,): 1.1, (0.4,): 1.0, (1.0,): 0.8},
    "frames": {(8,): 1.0, (16,): 1.0, (32,): 1.0, (0,): 1.0},
    "points": {(7_000,): 0.6, (27_500,): 1.0, (110_000,): 2.7},
    "caps": {(0.5, 0.5): 0.8, (2, 2): 1.4},
    "sh": {(0,): 0.9, (1,): 1.0, (2,): 1.1, (3,): 1.2},
    "perceptual": {("alex", 0): 1.0, ("alex", 4): 1.1, ("alex", 1): 1.3, ("vgg", 4): 1.5, ("vgg", 1): 3.2},
    "features": {(1024,): 0.7, (1536,): 1.0, (2048,): 1.3, (4096,): 4.0},
    "overlap": {(2,): 1.0, (5,): 1.8},
}
"""Axis of a sweep -> level -> time of its stage, relative. The phone clip, 2 cores, November 2026."""
