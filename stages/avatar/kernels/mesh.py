"""Ground truth on a CPU: a z-buffer for triangle meshes, and rays against textured boxes.

Axes are OpenCV's; the centre of the first pixel is at (0.5, 0.5); depths are z in metres. Doubles in a fixed order, so
the same input gives the same bytes.
"""

from __future__ import annotations

import numpy as np

from stages.avatar.kernels import njit, prange

NEAR = 0.05
SHININESS = 20.0
NO_LAMPS = np.zeros((0, 3))


@njit(cache=True)
def fill(points: np.ndarray, faces: np.ndarray, K: np.ndarray, width: int, height: int):
    """Nearest triangle behind each pixel centre of a mesh: `points` [V,3] in camera coordinates, `faces` [T,3].

    Returns depth [H,W] (infinite where empty), face [H,W] int32 (-1 where empty) and perspective-correct barycentric
    weights [H,W,3]. Raises ValueError if a vertex is nearer than NEAR: nothing is clipped.
    """
    depth = np.full((height, width), np.inf)
    face = np.full((height, width), -1, np.int32)
    weights = np.zeros((height, width, 3))
    x, y = np.empty(len(points)), np.empty(len(points))
    for i in range(len(points)):
        z = points[i, 2]
        if z < NEAR:
            raise ValueError("a vertex of the mesh is behind the camera")
        x[i], y[i] = K[0, 0] * points[i, 0] / z + K[0, 2], K[1, 1] * points[i, 1] / z + K[1, 2]
    for t in range(len(faces)):
        a, b, c = faces[t]
        area = (x[b] - x[a]) * (y[c] - y[a]) - (x[c] - x[a]) * (y[b] - y[a])
        if area == 0:
            continue
        left = max(int(np.ceil(min(x[a], x[b], x[c]) - 0.5)), 0)
        right = min(int(np.floor(max(x[a], x[b], x[c]) - 0.5)), width - 1)
        top = max(int(np.ceil(min(y[a], y[b], y[c]) - 0.5)), 0)
        bottom = min(int(np.floor(max(y[a], y[b], y[c]) - 0.5)), height - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                px, py = column + 0.5, row + 0.5
                wa = ((x[b] - px) * (y[c] - py) - (x[c] - px) * (y[b] - py)) / area
                wb = ((x[c] - px) * (y[a] - py) - (x[a] - px) * (y[c] - py)) / area
                wc = 1 - wa - wb
                if wa < 0 or wb < 0 or wc < 0:
                    continue
                wa, wb, wc = wa / points[a, 2], wb / points[b, 2], wc / points[c, 2]
                z = 1 / (wa + wb + wc)
                if z < depth[row, column]:
                    depth[row, column], face[row, column] = z, t
                    weights[row, column, 0] = wa * z
                    weights[row, column, 1] = wb * z
                    weights[row, column, 2] = wc * z
    return depth, face, weights


def covered(
    vertices: np.ndarray, faces: np.ndarray, viewmat: np.ndarray, K: np.ndarray, width: int, height: int
) -> np.ndarray:
    """bool [height,width]: the pixels whose centres a mesh covers; faces behind the camera are left out.

    `vertices` [V,3] in the world of `viewmat` [4,4] camera_from_world, `faces` [T,3], `K` [3,3] px.
    """
    local = vertices @ viewmat[:3, :3].T + viewmat[:3, 3]
    faces = np.asarray(faces, np.int64)
    faces = faces[(local[faces, 2] > NEAR).all(1)]
    local[:, 2] = np.maximum(local[:, 2], NEAR)
    return fill(local, faces, K, width, height)[1] >= 0


@njit(cache=True, parallel=True)
def cast(world_from_camera, K, width: int, height: int, boxes, paint, tints, mips, per_metre: float, light,
         gloss: float, lamps, open_air: bool):  # fmt: skip
    """Colour [H,W,3] and depth [H,W] of boxes seen along the rays through the pixel centres.

    `world_from_camera` [R,4,4] is one camera for the picture (R = 1) or one for each of its rows (R = H).
    `boxes` [B,8]: centre, half sizes (m), cosine and sine of a turn about y; box 0 is the room and is seen from inside.
    `paint` [B,6] is the texture of the faces -x +x -y +y -z +z, `tints` [B,3] multiplies it. `mips` is a tuple of
    texture stacks [T,S,S,3], each half the size before; they repeat, with `per_metre` texels a metre. `light` is the
    unit direction towards the lamp. Surfaces mirror `lamps` [L,3] (places in m) by `gloss`, blurred (Phong 1975).
    Colour is zero and depth infinite where a ray leaves the room; with `open_air` it has neither ceiling nor -z wall.
    """
    image = np.zeros((height, width, 3))
    depth = np.full((height, width), np.inf)
    lamp = (light[0], light[1], light[2])
    for row in prange(height):
        m = world_from_camera[min(np.int64(row), len(world_from_camera) - 1)]
        eye = (m[0, 3], m[1, 3], m[2, 3])
        spans = _spans(m, K, row, boxes)
        for column in range(width):
            u, v = (column + 0.5 - K[0, 2]) / K[0, 0], (row + 0.5 - K[1, 2]) / K[1, 1]
            ray = (m[0, 0] * u + m[0, 1] * v + m[0, 2], m[1, 0] * u + m[1, 1] * v + m[1, 2],
                   m[2, 0] * u + m[2, 1] * v + m[2, 2])  # fmt: skip
            best, which, face = np.inf, -1, -1
            for i in range(len(boxes)):
                if not spans[i, 0] <= column <= spans[i, 1]:
                    continue
                t, side = _meet(eye, ray, boxes, i)
                if t < best:
                    best, which, face = t, i, side
            if which < 0 or (open_air and which == 0 and (face == 3 or face == 4)):
                continue
            depth[row, column] = best
            hit = (eye[0] + best * ray[0], eye[1] + best * ray[1], eye[2] + best * ray[2])
            value, x, y, facing = _light(hit, ray, lamp, boxes, which, face)
            level = np.log2(max(best / K[0, 0] / np.sqrt(facing) * per_metre, 1.0))
            level = min(level, len(mips) - 1.001)
            fine = int(level)
            a = _texel(mips[fine], paint[which, face], x * per_metre / 2**fine, y * per_metre / 2**fine)
            b = _texel(mips[fine + 1], paint[which, face], x * per_metre / 2 ** (fine + 1),
                       y * per_metre / 2 ** (fine + 1))  # fmt: skip
            for c in range(3):
                image[row, column, c] = (a[c] + (b[c] - a[c]) * (level - fine)) * value * tints[which, c]
            if gloss > 0:
                image[row, column] += gloss * _mirrored(hit, ray, lamps, boxes[which], face)
    return image, depth


@njit(cache=True, inline="always")
def _turned(x, y, z, box):
    return box[6] * x - box[7] * z, y, box[7] * x + box[6] * z


@njit(cache=True)
def _spans(m, K, row, boxes):
    """First and last column [B,2] of a row in which each box can be seen: all, of the room and of a box that reaches behind the
    camera.
    """
    spans = np.empty((len(boxes), 2))
    for i in range(len(boxes)):
        box = boxes[i]
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for corner in range(8):
            x, y, z = (box[3] if corner & 1 else -box[3], box[4] if corner & 2 else -box[4],
                       box[5] if corner & 4 else -box[5])  # fmt: skip
            x, y, z = (box[0] + box[6] * x + box[7] * z - m[0, 3], box[1] + y - m[1, 3],
                       box[2] - box[7] * x + box[6] * z - m[2, 3])  # fmt: skip
            depth = m[0, 2] * x + m[1, 2] * y + m[2, 2] * z
            if i == 0 or depth < NEAR:
                left, right, top, bottom = -np.inf, np.inf, -np.inf, np.inf
                break
            column = K[0, 0] * (m[0, 0] * x + m[1, 0] * y + m[2, 0] * z) / depth + K[0, 2]
            line = K[1, 1] * (m[0, 1] * x + m[1, 1] * y + m[2, 1] * z) / depth + K[1, 2]
            left, right, top, bottom = min(left, column), max(right, column), min(top, line), max(bottom, line)
        spans[i] = (left - 1, right) if top - 1 <= row <= bottom else (1.0, 0.0)
    return spans


@njit(cache=True)
def _meet(eye, ray, boxes, i):
    """Where a ray enters box `i`, or leaves it if it is the room: distance (infinite: never) and face 0..5."""
    box = boxes[i]
    o = _turned(eye[0] - box[0], eye[1] - box[1], eye[2] - box[2], box)
    d = _turned(ray[0], ray[1], ray[2], box)
    enter, leave, first, last = -np.inf, np.inf, -1, -1
    for k in range(3):
        if d[k] == 0:
            if abs(o[k]) > box[3 + k]:
                return np.inf, -1
            continue
        per = 1 / d[k]
        low, high = (-box[3 + k] - o[k]) * per, (box[3 + k] - o[k]) * per
        front = 2 * k if d[k] > 0 else 2 * k + 1
        near, far = min(low, high), max(low, high)
        if near > enter:
            enter, first = near, front
        if far < leave:
            leave, last = far, front ^ 1
    if enter > leave or leave < NEAR:
        return np.inf, -1
    if i == 0:
        return leave, last
    return (enter, first) if enter > NEAR else (np.inf, -1)


@njit(cache=True)
def _light(point, ray, light, boxes, i, face):
    """Brightness of a hit (lamp, darker corners, contact shadows), its place on the texture in m, and n . ray."""
    box = boxes[i]
    hit = _turned(point[0] - box[0], point[1] - box[1], point[2] - box[2], box)
    d = _turned(ray[0], ray[1], ray[2], box)
    lamp = _turned(light[0], light[1], light[2], box)
    k = face // 2
    facing = abs(d[k]) / np.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
    outwards = (1.0 if face % 2 else -1.0) * (-1.0 if i == 0 else 1.0)
    value = 0.72 + 0.28 * max(0.0, outwards * lamp[k])
    across, along = (2, 1) if k == 0 else ((0, 2) if k == 1 else (0, 1))
    if i == 0:
        gap = min(box[3 + across] - abs(hit[across]), box[3 + along] - abs(hit[along]))
        value *= 1 - 0.3 * np.exp(-gap / 0.25)
        if face == 2:
            for other in range(1, len(boxes)):
                value *= 1 - 0.35 * np.exp(-_distance(point, boxes[other]) / 0.12)
    return value, hit[across] + 1.37 * i, hit[along] + 0.71 * i, facing


@njit(cache=True)
def _mirrored(point, ray, lamps, box, face):
    """How much of the lamps a blurred mirror in place of a box's face shows, 0 to 1 for each lamp."""
    hit = _turned(point[0], point[1], point[2], box)
    d = _turned(ray[0], ray[1], ray[2], box)
    shown = 0.0
    for lamp in lamps:
        to = _turned(lamp[0], lamp[1], lamp[2], box)
        across = along = away = 0.0
        for k in range(3):
            mirrored = -d[k] if k == face // 2 else d[k]
            across += mirrored * (to[k] - hit[k])
            along += d[k] ** 2
            away += (to[k] - hit[k]) ** 2
        shown += max(across / np.sqrt(along * away), 0.0) ** SHININESS
    return shown


@njit(cache=True)
def _distance(point, box):
    """How far a point of the floor is from the outline of a box that stands on it; infinite for low boxes."""
    if box[4] < 0.05 or box[1] - box[4] > 0.1:
        return np.inf
    x, _, z = _turned(point[0] - box[0], 0.0, point[2] - box[2], box)
    return np.hypot(max(abs(x) - box[3], 0.0), max(abs(z) - box[5], 0.0))


@njit(cache=True)
def _texel(stack, texture, x, y):
    """Bilinear colour of a repeating texture, texel centres at halves."""
    size = stack.shape[1]
    x, y = x - 0.5, y - 0.5
    x0, y0 = int(np.floor(x)), int(np.floor(y))
    fx, fy = x - x0, y - y0
    x1, y1 = (x0 + 1) % size, (y0 + 1) % size
    x0, y0 = x0 % size, y0 % size
    return (
        _between(stack[texture], y0, y1, x0, x1, fx, fy, 0),
        _between(stack[texture], y0, y1, x0, x1, fx, fy, 1),
        _between(stack[texture], y0, y1, x0, x1, fx, fy, 2),
    )


@njit(cache=True, inline="always")
def _between(tile, y0, y1, x0, x1, fx, fy, c):
    upper = tile[y0, x0, c] * (1 - fx) + tile[y0, x1, c] * fx
    lower = tile[y1, x0, c] * (1 - fx) + tile[y1, x1, c] * fx
    return upper * (1 - fy) + lower * fy
