"""Matches between the frames of made clips: points in space, a camera that travels, turns or zooms, and noise."""

import numpy as np
from scipy.spatial.transform import Rotation

from stages.avatar.cameras import lens
from stages.avatar.cameras import pinhole as cameras
from stages.estimators.cameras.motion import Pair

WIDTH, HEIGHT, FOCAL = 480, 360, 520.0
FRAMES = 24


def clip(
    turn: float,
    travel: float,
    flat: bool = False,
    k: float = 0.0,
    noise: float = 0.2,
    outliers: float = 0.0,
    focal: float = FOCAL,
    zoom: float = 1.0,
    forward: bool = False,
    count: int = FRAMES,
) -> tuple[list[Pair], np.ndarray]:
    """Pairs and views of a synthetic clip: `turn` degrees and `travel` metres to each side, points 3 to 8 m away.

    The focal length grows by `zoom`; `forward` travels to and fro. There are `count` frames.
    """
    rng = np.random.default_rng(5)
    points = rng.uniform([-6, -4, 3], [6, 4, 8], (1500, 3))
    if flat:
        points[:, 2] = 5 + 0.3 * points[:, 0]
    phase = np.linspace(0, 2 * np.pi, count)
    views = np.tile(np.eye(4), (count, 1, 1))
    angles = np.stack([turn * np.sin(phase), 0.4 * turn * np.sin(2 * phase), 0.2 * turn * np.cos(phase)], 1)
    views[:, :3, :3] = Rotation.from_euler("yxz", angles, degrees=True).as_matrix()
    at = np.stack([travel * np.sin(phase), 0.1 * travel * np.cos(phase), 0.2 * travel * np.sin(phase)], 1)
    at = at[:, ::-1] if forward else at
    views[:, :3, 3] = -(views[:, :3, :3] @ at[..., None])[..., 0]
    seen = []
    for view, longer in zip(views, np.linspace(1, zoom, count)):
        f, middle = focal * longer, np.array([WIDTH, HEIGHT]) / 2
        pixels, z = cameras.project(points, view, cameras.pinhole(f, WIDTH, HEIGHT))
        pixels = lens.distort((pixels - middle) / f, k) * f + middle + rng.normal(0, noise, pixels.shape)
        seen.append((pixels, (z > 0.1) & (pixels > 0).all(1) & (pixels < [WIDTH, HEIGHT]).all(1)))
    pairs = []
    for gap in (1, 2, 4, 8, 16):
        for i in range(count - gap):
            (a, in_a), (b, in_b) = seen[i], seen[i + gap]
            both = np.flatnonzero(in_a & in_b)[:200]
            wrong = rng.random(len(both)) < outliers
            moved = b[both] + wrong[:, None] * rng.normal(0, 60, (len(both), 2))
            if len(both) >= 15:
                pairs.append(Pair(i, i + gap, a[both], moved))
    return pairs, views
