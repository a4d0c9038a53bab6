"""Refinement of a pose: the outline of the vessels is brought onto the edge of what the network took for vessels.

Where a pixel lies on the surface is a guess that leans on all the rest of the image; where a vessel ends is seen on the
spot. Numpy and OpenCV only: nothing is rendered in the operating room.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ..geometry.camera import Camera
from ..geometry.silhouette import Silhouette
from .descent import Descent
from .pnp import PoseFit, projection_jacobian

POINTS = 600  # of the outline, at most
REACH_PX = 3.0  # farther from any seen edge, a point of the outline counts for nothing; of a network input of 128 px
SIGMA_PX = 0.6  # error of a seen edge
INDEPENDENT = 60.0  # the whole outline counts as this many independent points: neighbours err together
PRIOR = 100.0  # covariance of the fit is taken this many times: its pixels err together too
ITERATIONS = 10
FIELD_PX = 256  # edges are found between cells: on a raster this wide, or one of twice the cells


@dataclass(frozen=True)
class Alignment:
    """fit: the refined pose with its covariance. matched: share of the outline in view that found an edge.
    residual_px: mean distance of those from it. moved_mm: root mean square displacement of points at the mesh's rim.
    """

    fit: PoseFit
    matched: float
    residual_px: float
    moved_mm: float


class VesselAligner:
    """Holds the outline's edges of the exposed vessels for one network camera. vertices_mm (N, 3), triangles (F, 3)."""

    def __init__(self, vertices_mm: np.ndarray, triangles: np.ndarray, camera: Camera):
        self._vertices_mm = np.asarray(vertices_mm, float)
        self._silhouette = Silhouette(self._vertices_mm, triangles)
        self._radius_mm = float(np.linalg.norm(self._vertices_mm - self._vertices_mm.mean(axis=0), axis=1).max())
        self._camera = camera

    def align(self, fit: PoseFit, vessel_logit: np.ndarray, surface_logit: np.ndarray) -> Alignment:
        """Gauss-Newton from `fit`, which stays a prior. Logits (G, G), cells of 2 x 2 px of the camera's image."""
        scale = self._camera.width / 128
        field, in_view = _signed_distance(vessel_logit, surface_logit, scale)
        finer = field.shape[1] / self._camera.width
        focal = np.array([self._camera.fx, self._camera.fy])
        # The camera of the field, whose pixels are finer.
        field_focal = finer * focal[:, None]
        field_principal = finer * (np.array([[self._camera.cx], [self._camera.cy]]) + 0.5) - 0.5
        edges = self._silhouette.edges(fit.camera_from_world, facing_borders_only=True)
        if not len(edges):  # seen from behind, as by a mirrored picture, vessels that are open below have no outline
            return Alignment(fit, 0.0, REACH_PX, 0.0)
        edges = edges[:: len(edges) // POINTS + 1]
        relative = np.ascontiguousarray((self._vertices_mm[edges].mean(axis=1) - fit.centre_world_mm).T)
        descent = Descent(fit, fit, PRIOR)
        for _ in range(ITERATIONS):
            turned = descent.rotation @ relative
            seen = turned + descent.position[:, None]
            pixels = seen[:2] / np.maximum(seen[2], 1.0) * field_focal + field_principal
            where = np.ascontiguousarray(pixels.T, np.float32)[None]
            distance, along, down = cv2.split(
                cv2.remap(field, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e3, 0, 0))
            )
            inside = cv2.remap(in_view, where, None, cv2.INTER_NEAREST)[0] > 0
            distance = distance[0]
            weight = (1 - np.minimum(np.abs(distance) / (REACH_PX * scale), 1) ** 2) ** 2 * inside
            jacobian = projection_jacobian(turned, seen, focal)
            gradient = along[0] * jacobian[:, 0] + down[0] * jacobian[:, 1]
            count_as = INDEPENDENT / ((SIGMA_PX * scale) ** 2 * max(1, len(edges)))
            if descent.step(gradient, weight * count_as, -distance):
                break
        near = inside & (np.abs(distance) < REACH_PX * scale)
        refined = descent.result()
        if refined is None or not near.any():
            return Alignment(fit, 0.0, REACH_PX, 0.0)
        matched, residual = near.sum() / max(1, inside.sum()), np.abs(distance[near]).mean() / scale
        return Alignment(refined, float(matched), float(residual), descent.moved_mm(self._radius_mm))


def _signed_distance(vessel_logit, surface_logit, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) float32, px of the network's input: distance from the vessels' edge, negative inside, and its slope
    along x and y; and (H, W) uint8: 1 where the surface is seen all around. H and W are FIELD_PX, or 2 G if more."""
    times = max(2, round(FIELD_PX / vessel_logit.shape[1]))
    size = tuple(times * n for n in vessel_logit.shape[::-1])
    finer = times / 2  # field pixels per pixel of the network's input
    inside = (cv2.resize(vessel_logit.astype(np.float32), size) > 0).astype(np.uint8)
    outside_px = cv2.distanceTransform(1 - inside, cv2.DIST_L2, 5)
    inside_px = cv2.distanceTransform(inside, cv2.DIST_L2, 5)
    distance = cv2.GaussianBlur((outside_px - inside_px) * np.float32(1 / finer), (0, 0), 1.5)
    slope = finer / 8
    along = cv2.Sobel(distance, cv2.CV_32F, 1, 0, ksize=3, scale=slope)
    down = cv2.Sobel(distance, cv2.CV_32F, 0, 1, ksize=3, scale=slope)
    seen = (cv2.resize(surface_logit.astype(np.float32), size) > 0).astype(np.uint8)
    # The rim of what is seen looks like an edge of a vessel, and is none.
    margin = 2 * round(3 * scale * finer) + 1
    seen = cv2.erode(seen, np.ones((margin, margin), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0)
    return cv2.merge([distance, along, down]), seen
