"""Rows of numbers at moments between those at which they are known."""

from __future__ import annotations

import numpy as np


def between(moments: np.ndarray, times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values [P,C] at `moments` [P] s, linear between those [F,C] of rising `times` [F] s; before and after them as at the ends."""
    return np.stack([np.interp(moments, times, column) for column in values.T], 1)
