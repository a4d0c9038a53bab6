"""The overview: one frontal, almost orthographic view that shows the whole surface.

Method `surface` synthesises expected appearances there, once per texture and seed, and projects them back onto the
meshes; any other view then comes from rendering, consistent with the surface, instead of from another optimisation.
"""

from __future__ import annotations

import numpy as np

from ..case.meshes import Mesh
from ..geometry.camera import Camera
from ..geometry.pose import look_at
from ..poses.craniotomy import Craniotomy

DISTANCE_IN_SIZES = 40.0  # far enough that the view is orthographic to about 1 %
MARGIN = 1.03


def overview_view(craniotomy: Craniotomy, parenchyma: Mesh, size_px: int) -> tuple[Camera, np.ndarray]:
    """Camera (size_px square) and camera_from_world of the overview of `parenchyma`."""
    axis, up = craniotomy.outward_axis, craniotomy.up
    across = parenchyma.vertices_mm @ np.stack([np.cross(axis, up), up]).T
    middle = (across.min(axis=0) + across.max(axis=0)) / 2
    extent_mm = float((across.max(axis=0) - across.min(axis=0)).max()) * MARGIN
    height_mm = float((parenchyma.vertices_mm @ axis).mean())
    target = middle[0] * np.cross(axis, up) + middle[1] * up + height_mm * axis
    distance_mm = DISTANCE_IN_SIZES * extent_mm
    camera = Camera.from_field_of_view(size_px, size_px, extent_mm, distance_mm)
    return camera, look_at(target + distance_mm * axis, target, up)
