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
    """Prepares one mesh once; makes overlays of it for any pose and camera. Not for two threads at once."""

    def __init__(self, vessels: Mesh):
        self._vessels = vessels
        self._silhouette = Silhouette(vessels.vertices_mm, vessels.triangles)
        sides = np.concatenate([vessels.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
        self._edges, edge_of_side, count = np.unique(
            np.sort(sides, axis=1), axis=0, return_inverse=True, return_counts=True
        )
        # Sides in the order of their edges: the triangle of each and its direction, and where each edge begins.
        order = np.argsort(edge_of_side.ravel(), kind="stable")
        self._triangle_of_side = order % max(1, len(vessels.triangles))
        self._sign = np.where(sides[order, 0] < sides[order, 1], 1, -1).astype(np.int16)
        self._first_side = np.cumsum(count) - count
        self._is_closed = bool((count == 2).all())
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
        outline_mm, lines = self._silhouette.on_plane(pose, depth_mm)
        corners_mm = transform(pose, self._corners_mm)
        has_box = corners_mm[:, 2].min() > NEAREST_MM
        return Overlay(
            _pixels(camera, outline_mm),
            lines,
            self._fill(camera, pose, points_mm),
            _pixels(camera, corners_mm) if has_box else np.zeros((0, 2)),
            self._sides if has_box else np.zeros((0, 2), np.int64),
            depth_mm,
        )

    def _fill(self, camera: Camera, camera_from_world: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
        shrink = min(1.0, LARGEST_FILL_PX / max(camera.width, camera.height))
        small = camera.resized(max(1, round(camera.width * shrink)), max(1, round(camera.height * shrink)))
        in_front = (points_mm[self._vessels.triangles, 2] > NEAREST_MM).all(axis=1)
        near = points_mm.copy()
        near[:, 2] = np.maximum(near[:, 2], NEAREST_MM)  # of triangles that are left out; a zero would warn
        points_px = _pixels(small, near)
        towards = self._silhouette.towards(camera_from_world)
        seen = self._covered(points_px, towards & in_front, small)
        if not (self._is_closed and in_front.all()):  # through holes one sees the other side
            seen |= self._covered(points_px, ~towards & in_front, small)
        return seen.astype(np.uint8)

    def _covered(self, points_px: np.ndarray, used: np.ndarray, camera: Camera) -> np.ndarray:
        """bool (H, W): whether a triangle of those used covers each pixel centre; all of them face the same way.

        Edges between two of them cancel, so that only their common outline is drawn, as a winding number.
        """
        weight = np.add.reduceat(self._sign * used[self._triangle_of_side], self._first_side)
        chosen = np.nonzero(weight)[0]
        return winding(points_px[self._edges[chosen]], weight[chosen], camera.width, camera.height) != 0


def winding(edges_px: np.ndarray, weight: np.ndarray, width: int, height: int) -> np.ndarray:
    """int16 (height, width): how often directed edges (E, 2, 2), px, of closed outlines go around each pixel's centre.

    weight (E,): how often each edge counts. What lies outside the frame is cut off, not drawn at its side.
    """
    changes = np.zeros(height * (width + 1), np.int16)
    (x0, y0), (x1, y1) = edges_px[:, 0].T, edges_px[:, 1].T
    first = np.clip(np.ceil(np.minimum(y0, y1)), 0, height).astype(np.int64)
    rows = np.clip(np.ceil(np.maximum(y0, y1)), 0, height).astype(np.int64) - first
    which = np.repeat(np.arange(len(edges_px)), rows)
    row = first[which] + np.arange(len(which)) - np.repeat(np.cumsum(rows) - rows, rows)
    slope = (x1 - x0)[which] / (y1 - y0)[which]
    column = np.clip(np.ceil(x0[which] + (row - y0[which]) * slope), 0, width).astype(np.int64)
    sign = (np.sign(y1 - y0)[which] * np.rint(weight)[which]).astype(np.int16)
    np.add.at(changes, row * (width + 1) + column, sign)
    # In one run over all rows: each row's changes cancel, since outlines are closed.
    return np.cumsum(changes, dtype=np.int16).reshape(height, width + 1)[:, :-1]


def _pixels(camera: Camera, points_camera_mm: np.ndarray) -> np.ndarray:
    focal, centre = (camera.fx, camera.fy), (camera.cx, camera.cy)
    return points_camera_mm[:, :2] / points_camera_mm[:, 2:] * focal + centre
