"""Which way is up, where no floor tells: people hold cameras level, so their x axes lie in the horizon."""

from __future__ import annotations

import numpy as np

ROLL, PITCH = np.radians(2), np.radians(20)  # of a hand-held camera; its pitch is whatever the subject asks for


def camera_up(viewmats: np.ndarray) -> tuple[np.ndarray, float]:
    """The likely up axis [3] of the world of `viewmats` [F,4,4], and its standard deviation in rad.

    Square to the cameras' x axes within ROLL and along their -y axes within PITCH, by least squares. A camera that goes
    around the person settles both angles; one that stands or goes straight leaves the pitch open.
    """
    across, down = viewmats[:, 0, :3], viewmats[:, 1, :3].mean(0)
    down = down / np.linalg.norm(down)
    information = across.T @ across / len(across) / ROLL**2 + np.eye(3) / PITCH**2
    up = np.linalg.solve(information, -down / PITCH**2)
    up = up / np.linalg.norm(up)
    tangent = np.linalg.svd(up[None])[2][1:]
    return up, float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(tangent @ information @ tangent.T)).max()))
