"""Images that a registration must refuse: not this case's cortex, made from views of it."""

from __future__ import annotations

import cv2
import numpy as np

from . import elastic


def impostor(image: np.ndarray, rng) -> np.ndarray:
    """uint8 RGB of the size of `image`: mirrored (no rotation makes it the same), mirrored and bent into vessels that
    run otherwise, shuffled, or plain noise down to a blank frame."""
    kind = rng.integers(4)
    if kind == 0:
        return np.ascontiguousarray(image[:, ::-1])
    if kind == 1:
        size = min(image.shape[:2])
        field = elastic.displacement_field(image.shape[:2], 0.1 * size, size * rng.uniform(0.3, 0.5), rng)
        return elastic.warp(np.ascontiguousarray(image[:, ::-1]), field)
    if kind == 2:
        return _shuffled(image, rng)
    coarse = rng.integers(0, 256, (*rng.integers(1, 40, 2), 3)).astype(np.uint8)
    return cv2.resize(coarse, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)


def _shuffled(image: np.ndarray, rng) -> np.ndarray:
    parts = int(rng.integers(3, 7))
    side = len(image) // parts
    tiles = [(r * side, c * side) for r in range(parts) for c in range(parts)]
    result = image.copy()
    for (row, column), k in zip(tiles, rng.permutation(len(tiles))):
        tile = image[tiles[k][0] : tiles[k][0] + side, tiles[k][1] : tiles[k][1] + side]
        result[row : row + side, column : column + side] = np.rot90(tile, rng.integers(4))
    return result
