"""Colour profiles: RGB with primaries and a tone curve of one's own, by the ICC's specification (version 2, matrix and curve)."""

from __future__ import annotations

import struct

import numpy as np

WHITE = np.array([0.9642, 1.0, 0.8249])  # D50, to which a profile's colours are adapted
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
D65, D50 = (0.3127, 0.3290), (0.3457, 0.3585)
SPACES = {  # x and y of red, green, blue and white; gamma
    "Display P3": ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060), D65, 2.2),
    "Adobe RGB (1998)": ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06), D65, 563 / 256),
    "ProPhoto RGB": ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001), D50, 1.8),
    "sRGB, linear": ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), D65, 1.0),
    "Rec. 2020": ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046), D65, 2.4),
}


def to_d50(red, green, blue, white, gamma=None) -> np.ndarray:
    """XYZ [3,3] of the primaries, a column each, adapted to D50 (Bradford)."""
    xyz = np.array([[x / y, 1, (1 - x - y) / y] for x, y in (red, green, blue, white)]).T
    primaries, source = xyz[:, :3], xyz[:, 3]
    matrix = primaries * np.linalg.solve(primaries, source)
    ratio = (BRADFORD @ WHITE) / (BRADFORD @ source)
    return np.linalg.inv(BRADFORD) @ (ratio[:, None] * (BRADFORD @ matrix))


def profile(name: str) -> bytes:
    """The file of one of SPACES."""
    *_, gamma = SPACES[name]
    matrix = to_d50(*SPACES[name])
    fixed = [round(65536 * value) for value in (*WHITE, *matrix.T.flatten())]
    xyz = [b"XYZ \0\0\0\0" + struct.pack(">3i", *fixed[at : at + 3]) for at in range(0, 12, 3)]
    text = name.encode() + b"\0"
    words = b"desc\0\0\0\0" + struct.pack(">I", len(text)) + text + bytes(78)
    curve = b"curv\0\0\0\0" + struct.pack(">IH", 1, round(256 * gamma))
    keys = (b"wtpt", b"rXYZ", b"gXYZ", b"bXYZ", b"desc", b"cprt", b"rTRC", b"gTRC", b"bTRC")
    parts = [*xyz, words, b"text\0\0\0\0none\0", curve, curve, curve]
    table, body, at = b"", b"", 132 + 12 * len(keys)
    for key, part in zip(keys, parts, strict=True):
        table += key + struct.pack(">II", at + len(body), len(part))
        body += part + bytes(-len(part) % 4)
    head = struct.pack(">I4sI4s4s4s", at + len(body), b"lcms", 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    head += struct.pack(">6H", 2026, 1, 1, 0, 0, 0) + b"acsp" + bytes(28) + struct.pack(">3i", *fixed[:3])
    return head + bytes(128 - len(head)) + struct.pack(">I", len(keys)) + table + body


def in_srgb(name: str, pixels: np.ndarray) -> np.ndarray:
    """Pixels uint8 [...,3] of that space as sRGB, 0 to 255, by formulas; what sRGB has not is cut off."""
    gamma = SPACES[name][4]
    srgb = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06), D65)
    linear = (pixels / 255.0) ** gamma @ to_d50(*SPACES[name]).T @ np.linalg.inv(to_d50(*srgb)).T
    linear = linear.clip(0, 1)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
