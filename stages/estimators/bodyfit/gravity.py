"""Which way is up where no floor tells, or where the floor slopes: people hold cameras level, and stand upright."""

from __future__ import annotations

import numpy as np

ROLL, PITCH = np.radians(2), np.radians(20)  # of a hand-held camera; its pitch is whatever the subject asks for
LEAN = np.radians(8)  # of a body over its feet, in the mean of a clip; along the view landmarks lean as much
UPRIGHT = np.cos(np.radians(30))  # between the floor's normal and somebody who stands
UPRIGHT_LEAST = 0.5  # cosine of the angle to up, from which a trunk tells of it
SLOPE = np.radians(6)  # up to which a floor counts as level
APART = 0.5  # of the cameras' roll against a floor that slopes, which there may be against the bodies


def camera_up(viewmats: np.ndarray) -> tuple[np.ndarray, float]:
    """The likely up axis [3] of the world of `viewmats` [F,4,4], and its standard deviation in rad.

    Square to the cameras' x axes within ROLL and along their -y axes within PITCH, by least squares. A camera that goes
    around the person settles both angles; one that stands or goes straight leaves the pitch open.
    """
    down = viewmats[:, 1, :3].mean(0)
    return _square_to(viewmats[:, 0, :3], -down / np.linalg.norm(down), PITCH)


def trunk_up(trunks: np.ndarray, held: np.ndarray) -> np.ndarray:
    """The mean direction [3] of trunks [F,3], unit vectors from pelvis to neck, that are upright against `held` [3], what the
    cameras take for up; `held` itself where nobody is, as of people who lie."""
    upright = trunks @ held > UPRIGHT_LEAST
    if not upright.any():
        return held
    mean = trunks[upright].mean(0)
    return mean / np.linalg.norm(mean)


def up_on_slope(viewmats: np.ndarray, normal: np.ndarray, bodies: np.ndarray) -> tuple[np.ndarray, float] | None:
    """What `camera_up` gives, where the floor with `normal` [3] is not level; None where it may be.

    `bodies` [F,3] are unit vectors, in the world of `viewmats` [F,4,4], from the feet of a person to their mass. Cameras
    that are rolled are so against floor and bodies alike; on a slope they are against the floor alone. Bodies count
    across the view, where pictures show how they lean, and along it only for how much.
    """
    stands = bodies @ normal > UPRIGHT
    if stands.mean() < 0.5:
        return None
    across, bodies = viewmats[stands, 0, :3], bodies[stands]
    rolls = (across * bodies).sum(1)
    steady = across @ np.linalg.lstsq(across, rolls, rcond=None)[0]  # what one direction of all bodies explains
    against_floor, against_bodies = (np.sqrt(np.mean(angles**2)) for angles in (across @ normal, steady))
    if against_floor < ROLL or against_bodies > APART * against_floor:
        return None
    up, spread = _square_to(across, bodies.mean(0), LEAN)
    return (up, spread) if up @ normal < np.cos(SLOPE) else None


def _square_to(across: np.ndarray, toward: np.ndarray, spread: float) -> tuple[np.ndarray, float]:
    """The unit vector [3] square to `across` [F,3] within ROLL and along `toward` [3] within `spread` rad; its deviation in rad."""
    information = across.T @ across / len(across) / ROLL**2 + np.eye(3) / spread**2
    up = np.linalg.solve(information, toward / spread**2)
    up = up / np.linalg.norm(up)
    tangent = np.linalg.svd(up[None])[2][1:]
    return up, float(np.sqrt(np.linalg.eigvalsh(np.linalg.inv(tangent @ information @ tangent.T)).max()))
