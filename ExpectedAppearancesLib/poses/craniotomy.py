"""Where the surgeon looks from: the centre of the craniotomy and the axis that points out of the head."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..case.meshes import Mesh
from ..errors import InputError

REACH = 1.75  # of the vessels' radius: how far around them a cortex is seen and synthesised
CLOSED_SHARE = 0.05  # a surface that faces one way by less is closed, but for small holes


@dataclass(frozen=True)
class Craniotomy:
    """centre_world_mm (3,), outward unit axis (3,), and `up` (3,): the image-up direction of an upright microscope."""

    centre_world_mm: np.ndarray
    outward_axis: np.ndarray
    up: np.ndarray


def find_craniotomy(
    vessels: Mesh,
    cortex: Mesh | None = None,
    space: str = "LPS",
    point_world_mm: np.ndarray | None = None,
    normal: np.ndarray | None = None,
) -> Craniotomy:
    """From a point and normal, else from the cortex model, else fitted to the vessels.

    The centre is the vessels' centroid unless a point is given. Raises InputError for a normal of length 0.
    """
    centre = vessels.centroid_mm if point_world_mm is None else np.asarray(point_world_mm, float)
    if normal is not None:
        axis = np.asarray(normal, float)
    elif cortex is not None:
        axis = _axis_of_cortex(near_vessels(cortex, vessels), vessels)
    else:
        axis = _axis_of_vessels(vessels)
    length = np.linalg.norm(axis)
    if not np.isfinite(length) or length < 1e-9:
        raise InputError("craniotomy: the outward axis cannot be found; give a point and an outward normal.")
    if normal is None or abs(length - 1) > 1e-9:  # one that was recorded stays the very same
        axis = axis / length
    return Craniotomy(centre, axis, upright(axis, space))


def upright(axis: np.ndarray, space: str) -> np.ndarray:
    """Unit vector across `axis` that is closest to the patient's superior direction, or anterior at the crown."""
    superior = np.array([0.0, 0.0, 1.0])
    anterior = np.array([0.0, -1.0 if space == "LPS" else 1.0, 0.0])
    reference = superior if abs(axis @ superior) < np.cos(np.radians(25)) else anterior
    across = reference - axis * (reference @ axis)
    return across / np.linalg.norm(across)


def parenchyma_around(vessels: Mesh, cortex: Mesh | None, outward_axis: np.ndarray) -> Mesh:
    """What is seen beside the vessels: the cortex near them, or a disc where there is no cortex model."""
    return disc_under_vessels(vessels, outward_axis) if cortex is None else near_vessels(cortex, vessels)


def near_vessels(cortex: Mesh, vessels: Mesh) -> Mesh:
    """The part of a cortex, which may be that of a whole brain, within REACH of the vessels; all of it where it is no
    larger, or nowhere near."""
    if _is_within_reach(cortex, vessels):
        return cortex
    corners_mm = cortex.vertices_mm[cortex.triangles] - vessels.centroid_mm
    middles_mm = corners_mm.mean(axis=1)
    # By the sphere around each: a large triangle may pass the vessels with all its corners far away.
    sizes_mm = np.linalg.norm(corners_mm - middles_mm[:, None], axis=2).max(axis=1)
    kept = cortex.triangles[np.linalg.norm(middles_mm, axis=1) - sizes_mm <= REACH * vessels.radius_mm]
    if not len(kept):
        return cortex
    used, triangles = np.unique(kept, return_inverse=True)
    return Mesh(cortex.vertices_mm[used], triangles.reshape(-1, 3))


def disc_under_vessels(vessels: Mesh, outward_axis: np.ndarray) -> Mesh:
    """Parenchyma for a case without a cortex model: a disc just below all vessels, 15 % wider than they are."""
    heights = (vessels.vertices_mm - vessels.centroid_mm) @ outward_axis
    centre = vessels.centroid_mm + outward_axis * (heights.min() - 0.1)
    helper = np.eye(3)[np.argmin(np.abs(outward_axis))]
    right = np.cross(outward_axis, helper)
    right /= np.linalg.norm(right)
    up = np.cross(outward_axis, right)
    segments = 96
    angle = np.linspace(0, 2 * np.pi, segments, endpoint=False)[:, None]
    rim = centre + 1.15 * vessels.radius_mm * (np.cos(angle) * right + np.sin(angle) * up)
    index = np.arange(segments)
    triangles = np.stack([np.zeros(segments, int), index + 1, (index + 1) % segments + 1], axis=1)
    return Mesh(np.vstack([centre, rim]), triangles)


def has_own_axis(cortex: Mesh, vessels: Mesh) -> bool:
    """Whether the axis of this cortex is the same wherever the vessels lie on it: neither is it larger than what is
    seen around them, nor does it face all ways."""
    return _is_within_reach(cortex, vessels) and _one_way(cortex)[1] >= CLOSED_SHARE


def _is_within_reach(cortex: Mesh, vessels: Mesh) -> bool:
    distances_mm = np.linalg.norm(cortex.vertices_mm - vessels.centroid_mm, axis=1)
    return bool((distances_mm <= REACH * vessels.radius_mm).all())


def _axis_of_cortex(cortex: Mesh, vessels: Mesh) -> np.ndarray:
    """Area-weighted mean normal. Triangle order may be inside out, so the sign comes from the surface's bulge."""
    mean, share = _one_way(cortex)
    if share < CLOSED_SHARE:
        # Which side is out is where the vessels lie on it.
        axis = _flattest_direction(vessels.vertices_mm)
        return axis if axis @ (vessels.centroid_mm - cortex.centroid_mm) > 0 else -axis
    if share < 0.3:
        # Mixed: the flattest direction is what is left.
        mean = _flattest_direction(cortex.vertices_mm)
    return _towards_bulge(mean, cortex.vertices_mm)


def _one_way(mesh: Mesh) -> tuple[np.ndarray, float]:
    """Area-weighted sum of the triangles' normals (3,), and its share, 0..1, of what it is where all face one way."""
    corners = mesh.vertices_mm[mesh.triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = normals.sum(axis=0)
    return total, float(np.linalg.norm(total) / max(np.linalg.norm(normals, axis=1).sum(), 1e-12))


def _axis_of_vessels(vessels: Mesh) -> np.ndarray:
    return _towards_bulge(_flattest_direction(vessels.vertices_mm), vessels.vertices_mm)


def _flattest_direction(points_mm: np.ndarray) -> np.ndarray:
    return np.linalg.svd(points_mm - points_mm.mean(axis=0), full_matrices=False)[2][2]


def _towards_bulge(axis: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
    """A brain is convex: along the outward axis its middle lies higher than its rim."""
    axis = axis / np.linalg.norm(axis)
    offset = points_mm - points_mm.mean(axis=0)
    height = offset @ axis
    distance_2 = (offset**2).sum(axis=1) - height**2
    rises_outwards = (distance_2 - distance_2.mean()) @ height > 0
    return -axis if rises_outwards else axis
