"""Elastic deformation that imitates brain shift in the image and keeps the pose label true (paper, section 2.2).

A deformation with an affine part moves, turns or scales the whole view: the label would be wrong by millimetres.
So the affine part is removed exactly: what is left bends the image without moving it as a whole. The tissue in view is
only a part of the image, which the bending does move: the label follows it (`nearest_pose`).
"""

from __future__ import annotations

import functools
import math

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.pose import pose_from_rotation, rotation_matrix, rotation_vector

FITTED_POINTS, LEAST_FITTED_POINTS = 250, 50


def displacement_field(
    shape_hw: tuple[int, int], amplitude_px: float, smoothness_px: float, rng: np.random.Generator
) -> np.ndarray:
    """Smooth random displacement (H, W, 2), float32, px: x then y, without any affine part.

    amplitude_px: length of the longest displacement. smoothness_px: distance over which displacements differ; the
    field does not fold while amplitude_px stays below about a quarter of it. The least-squares best-fit affine of the
    field over the pixel grid is zero (to float32). Raises ValueError for sizes below 4 px or values out of range.
    """
    height, width = shape_hw
    if min(height, width) < 4 or amplitude_px < 0 or smoothness_px < 1:
        raise ValueError(f"shape {shape_hw}, amplitude {amplitude_px} px, smoothness {smoothness_px} px: out of range")
    if amplitude_px == 0:
        return np.zeros((height, width, 2), np.float32)
    # With fewer than three nodes across, little but an affine field could come out.
    spacing_px = min(float(smoothness_px), min(height, width) / 3)
    rows, columns = (math.ceil(size / spacing_px) + 2 for size in (height, width))
    nodes = rng.standard_normal((rows, columns, 2), np.float32)
    size = (round(columns * spacing_px), round(rows * spacing_px))
    field = cv2.resize(nodes, size, interpolation=cv2.INTER_CUBIC)
    # A random offset, so that the nodes have no preferred place in the image.
    top, left = rng.integers(0, size[1] - height + 1), rng.integers(0, size[0] - width + 1)
    field = without_affine_part(field[top : top + height, left : left + width])
    longest = float(cv2.magnitude(field[..., 0].copy(), field[..., 1].copy()).max())
    return (field * (amplitude_px / longest)).astype(np.float32)


def without_affine_part(field_px: np.ndarray) -> np.ndarray:
    """The field (H, W, 2) less its least-squares best-fit affine over the pixel grid, as float64."""
    height, width = field_px.shape[:2]
    basis, flat = _affine_basis(height, width), field_px.reshape(height * width, 2).astype(np.float64)
    return (flat - basis.T @ (basis @ flat)).reshape(height, width, 2)


@functools.lru_cache(maxsize=8)
def _affine_basis(height: int, width: int) -> np.ndarray:
    """Orthonormal basis (3, H*W) of {1, x, y}: on a full pixel grid the centred x and y are orthogonal."""
    y, x = np.mgrid[:height, :width].astype(np.float64)
    basis = np.stack([np.ones(height * width), (x - x.mean()).ravel(), (y - y.mean()).ravel()])
    return basis / np.linalg.norm(basis, axis=1, keepdims=True)


def warp(image: np.ndarray, field_px: np.ndarray) -> np.ndarray:
    """Image (H, W, C) whose pixel (x, y) shows what `image` has at (x, y) + field (H, W, 2); reflected at the border.

    Raises ValueError for a field of another size.
    """
    height, width = image.shape[:2]
    if field_px.shape != (height, width, 2):
        raise ValueError(f"field {field_px.shape} does not fit image {image.shape}")
    x, y = _grid(height, width)
    source_x, source_y = x + field_px[..., 0], y + field_px[..., 1]
    return cv2.remap(image, source_x, source_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)


def nearest_pose(
    camera_from_world: np.ndarray, points_mm: np.ndarray, surface: np.ndarray, camera: Camera
) -> np.ndarray:
    """The pose (4, 4) that brings the surface of a bent view closest to where it is seen: least squares of pixels.

    camera_from_world: before it was bent. points_mm (G, G, 3): the surface point, world, that each cell of a grid over
    the camera's whole image shows, where surface (G, G) says so.
    """
    rows, columns = np.nonzero(surface)
    chosen = slice(None, None, len(rows) // FITTED_POINTS + 1)
    rows, columns = rows[chosen], columns[chosen]
    if len(rows) < LEAST_FITTED_POINTS:
        return camera_from_world
    seen_px = (np.stack([columns, rows], axis=1) + 0.5) * (camera.width / surface.shape[1]) - 0.5
    points = points_mm[rows, columns].astype(np.float64)
    centre = points.mean(axis=0)
    rotation = camera_from_world[:3, :3]
    start = rotation_vector(rotation)[:, None], (rotation @ centre + camera_from_world[:3, 3])[:, None]
    turned, moved_mm = cv2.solvePnPRefineLM(points - centre, seen_px, camera.matrix, None, *start)
    rotation = rotation_matrix(turned.ravel())
    return pose_from_rotation(rotation, moved_mm.ravel() - rotation @ centre)


@functools.lru_cache(maxsize=8)
def _grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return x, y
