"""How far a mesh lies, in the camera frame, from where another pose puts it."""

from __future__ import annotations

import numpy as np


def add_mm(vertices_mm: np.ndarray, true: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """ADD (N,) of the vertices (V, 3) under poses camera_from_world (N, 4, 4), mm."""
    return mean_displacements_mm(vertices_mm, true, predicted)[0]


def mean_displacements_mm(vertices_mm: np.ndarray, true: np.ndarray, predicted: np.ndarray) -> tuple[np.ndarray, ...]:
    """Mean over the vertices of the displacement, its part across and its part along the optical axis; each (N,) mm."""
    vertices_mm = np.asarray(vertices_mm, float)
    means = np.empty((3, len(true)))
    for i, difference in enumerate(np.asarray(true, float) - np.asarray(predicted, float)):
        x, y, z = difference[:3, :3] @ vertices_mm.T + difference[:3, 3:]
        lateral_2 = x * x + y * y
        means[:, i] = np.sqrt(lateral_2 + z * z).mean(), np.sqrt(lateral_2).mean(), np.abs(z).mean()
    return tuple(means)
