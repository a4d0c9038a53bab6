"""What is drawn over a frame for a pose: outline, filled vessels and bounding box, in pixels of that frame.

Pure geometry of one camera and one pose: whoever draws it puts pixels onto the image plane.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from ..case.meshes import Mesh
from ..geometry.camera import Camera
from ..geometry.pose import transform
from ..geometry.silhouette import Silhouette

LARGEST_FILL_PX = 640  # longest side of the filled overlay's raster: finer costs time and shows nothing more
NEAREST_MM = 1.0


@dataclass(frozen=True, eq=False)
class Overlay:
    """outline_px (P, 2) and outline_lines (E, 2), its ends; fill (h, w) uint8, 1 in the vessels, over the whole frame;
    box_px (8, 2) and box_lines (12, 2), empty where a corner of the box lies behind the camera; depth_mm: of the
    vessels, the median of their vertices."""

    outline_px: np.ndarray
    outline_lines: np.ndarray
    fill: np.ndarray
    box_px: np.ndarray
    box_lines: np.ndarray
    depth_mm: float


class OverlayMaker:
    """Prepares one mesh once; makes overlays of it for any pose and camera, also in two threads at once."""

    def __init__(self, vessels: Mesh):
        self._vessels = vessels
        self._silhouette = Silhouette(vessels.vertices_mm, vessels.triangles)
        low, high = vessels.vertices_mm.min(axis=0), vessels.vertices_mm.max(axis=0)
        sides = list(itertools.product((0, 1), repeat=3))
        self._corners_mm = np.where(sides, high, low)
        self._sides = np.array([(i, j) for i, j in itertools.combinations(range(8), 2) if bin(i ^ j).count("1") == 1])

    def make(self, camera: Camera, camera_from_world: np.ndarray) -> Overlay | None:
        """Overlay of a frame of `camera` (without distortion); None when no vessel lies in front of the camera."""
        pose = np.asarray(camera_from_world, float)
        points_mm = transform(pose, self._vessels.vertices_mm)
        depth_mm = float(np.median(points_mm[:, 2]))
        if depth_mm <= NEAREST_MM:
            return None
        towards = self._silhouette.towards(pose)
        edges = self._silhouette.edges_facing(towards)
        if points_mm[:, 2].min() <= depth_mm / 100:  # too near for a place in the picture
            edges = edges[(points_mm[edges, 2] > depth_mm / 100).all(axis=1)]
        used, lines = self._silhouette.renumbered(edges)
        corners_mm = transform(pose, self._corners_mm)
        has_box = corners_mm[:, 2].min() > NEAREST_MM
        return Overlay(
            _pixels(camera, points_mm[used]),
            lines,
            self._fill(camera, towards, points_mm),
            _pixels(camera, corners_mm) if has_box else np.zeros((0, 2)),
            self._sides if has_box else np.zeros((0, 2), np.int64),
            depth_mm,
        )

    def _fill(self, camera: Camera, towards: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
        shrink = min(1.0, LARGEST_FILL_PX / max(camera.width, camera.height))
        small = camera.resized(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))
        if points_mm[:, 2].min() > NEAREST_MM:
            seen = self._covered(points_mm, towards, small)
            # Through holes one sees the other side.
            return seen if self._silhouette.is_closed else seen | self._covered(points_mm, ~towards, small)
        near = (points_mm[self._vessels.triangles, 2] <= NEAREST_MM).any(axis=1)
        return self._covered(points_mm, towards & ~near, small) | self._covered(points_mm, ~towards & ~near, small)

    def _covered(self, points_mm: np.ndarray, used: np.ndarray, camera: Camera) -> np.ndarray:
        """uint8 (H, W): 1 where a triangle of those used covers a pixel's centre; all of them face the same way.

        Edges between two of them cancel, so that only their common outline is drawn, as a winding number.
        """
        edges, weight = self._silhouette.boundary(used)
        return (winding(_pixels(camera, points_mm[edges]), weight, camera.width, camera.height) != 0).view(np.uint8)


def winding(edges_px: np.ndarray, weight: np.ndarray, width: int, height: int) -> np.ndarray:
    """int16 (height, width): how often directed edges (E, 2, 2), px, of closed outlines go around each pixel's centre.

    weight (E,): how often each edge counts. What lies outside the frame is cut off, not drawn at its side.
    """
    (x0, y0), (x1, y1) = edges_px[:, 0].T, edges_px[:, 1].T
    first = np.clip(np.ceil(np.minimum(y0, y1)), 0, height).astype(np.int64)
    rows = np.clip(np.ceil(np.maximum(y0, y1)), 0, height).astype(np.int64) - first
    which = np.repeat(np.arange(len(edges_px)), rows)
    row = first[which] + np.arange(len(which)) - np.repeat(np.cumsum(rows) - rows, rows)
    slope = (x1 - x0)[which] / (y1 - y0)[which]
    column = np.clip(np.ceil(x0[which] + (row - y0[which]) * slope), 0, width).astype(np.int64)
    sign = (np.sign(y1 - y0)[which] * np.rint(weight)[which]).astype(np.int16)
    # In one run over all rows, from crossing to crossing: each row's cancel, since outlines are closed.
    place = row * (width + 1) + column
    order = np.argsort(place)
    count = np.concatenate([[0], np.cumsum(sign[order])]).astype(np.int16)
    length = np.diff(place[order], prepend=0, append=height * (width + 1))
    return np.repeat(count, length).reshape(height, width + 1)[:, :-1]


def _pixels(camera: Camera, points_camera_mm: np.ndarray) -> np.ndarray:
    focal, centre = (camera.fx, camera.fy), (camera.cx, camera.cy)
    return points_camera_mm[..., :2] / points_camera_mm[..., 2:] * focal + centre
