"""The outline of a surface as a camera in perspective sees it."""

from __future__ import annotations

import numpy as np


class Silhouette:
    """Edges of a surface between a triangle that faces the camera and one that does not, and its border edges.

    The edges are matched to triangles once, so that asking again for another pose is fast.
    vertices_mm (N, 3), triangles (F, 3) indices of vertices.
    """

    def __init__(self, vertices_mm: np.ndarray, triangles: np.ndarray):
        self._vertices_mm = np.asarray(vertices_mm, float)
        self._triangles = np.asarray(triangles)
        a, b, c = (self._vertices_mm[triangles[:, i]] for i in range(3))
        self._middle_mm = self._vertices_mm.mean(axis=0) if len(self._vertices_mm) else np.zeros(3)
        self._face_normals = np.cross(b - a, c - a)
        self._face_offsets = np.einsum("ij,ij->i", self._face_normals, a - self._middle_mm)
        starts, ends = triangles.T.ravel(), triangles[:, [1, 2, 0]].T.ravel()
        count, low = len(self._vertices_mm), np.minimum(starts, ends).astype(np.int64)
        keys, edge_of_side = np.unique(low * count + np.maximum(starts, ends), return_inverse=True)
        self._edges = np.stack([keys // count, keys % count], axis=1)
        self._sides = np.bincount(edge_of_side.ravel(), minlength=len(keys)).astype(np.int16)
        self._is_border = self._sides == 1
        # The triangles at each edge and the way they go along it, one per row; where an edge has fewer, one that is not
        # there, behind all others.
        order = np.argsort(edge_of_side.ravel(), kind="stable")
        edge = edge_of_side.ravel()[order]
        row = np.arange(len(order)) - (np.cumsum(self._sides, dtype=int) - self._sides)[edge]
        self._triangles_at = np.full((self._sides.max(initial=0), len(keys)), len(triangles))
        self._triangles_at[row, edge] = order % max(1, len(triangles))
        self._signs_at = np.zeros(self._triangles_at.shape, np.int8)
        self._signs_at[row, edge] = np.where(starts < ends, 1, -1)[order]
        self.is_closed = bool((self._sides == 2).all())

    def edges(self, camera_from_world: np.ndarray, facing_borders_only: bool = False) -> np.ndarray:
        """(E, 2) indices of the vertices of the outline's edges, from an OpenCV pose. Hidden outlines are included.

        facing_borders_only: leave out border edges of triangles that turn their back, which mostly hide behind others.
        """
        return self.edges_facing(self.towards(camera_from_world), facing_borders_only)

    def edges_facing(self, towards: np.ndarray, facing_borders_only: bool = False) -> np.ndarray:
        """As `edges`, from what `towards` said (F,)."""
        return self._edges[self._is_outline(self._at_edges(towards), facing_borders_only)]

    def boundary(self, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The closed curves around the triangles chosen (F,): edges (E, 2) and how often each is gone along (E,).

        Negative: from its second vertex to its first. Edges between two of the triangles cancel.
        """
        weight = (self._at_edges(chosen) * self._signs_at).sum(axis=0, dtype=np.int16)
        there = np.flatnonzero(weight)
        return self._edges[there], weight[there]

    def edges_with_inside(self, camera_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `edges` with facing borders only, and for each edge (E,) the third vertex of a triangle at it that faces
        the camera: the side on which the surface is seen."""
        towards_at = self._at_edges(self.towards(camera_from_world))
        chosen = np.flatnonzero(self._is_outline(towards_at, facing_borders_only=True))
        edges, first = self._edges[chosen], towards_at[:, chosen].argmax(axis=0)
        return edges, self._triangles[self._triangles_at[first, chosen]].sum(axis=1) - edges.sum(axis=1)

    def _at_edges(self, said: np.ndarray) -> np.ndarray:
        """What is said of each triangle (F,), bool, for those at each edge (S, E); False where none is."""
        return np.append(said, False)[self._triangles_at]

    def _is_outline(self, towards_at: np.ndarray, facing_borders_only: bool) -> np.ndarray:
        facing = towards_at.sum(axis=0, dtype=np.int16)
        between = (facing > 0) & (facing < self._sides)
        return between | (self._is_border & (facing > 0) if facing_borders_only else self._is_border)

    def towards(self, camera_from_world: np.ndarray) -> np.ndarray:
        """bool (F,): whether each triangle faces the camera."""
        centre_mm = -camera_from_world[:3, :3].T @ camera_from_world[:3, 3]
        return self._face_normals @ (centre_mm - self._middle_mm) > self._face_offsets

    def on_plane(self, camera_from_world: np.ndarray, plane_depth_mm: float) -> tuple[np.ndarray, np.ndarray]:
        """The outline seen from the pose, drawn on the plane z = plane_depth_mm of the camera.

        Returns points (P, 3), camera mm, and lines (E, 2) indices of points. What lies nearer to the camera than a
        hundredth of the plane is left out: it has no place on the plane.
        """
        points_mm = self._vertices_mm @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        edges = self.edges(camera_from_world)
        edges = edges[(points_mm[edges, 2] > plane_depth_mm / 100).all(axis=1)]
        used, lines = self.renumbered(edges)
        points_mm = points_mm[used]
        return points_mm * (plane_depth_mm / points_mm[:, 2:3]), lines

    def renumbered(self, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The vertices that edges (E, 2) use, in their order, and the edges as indices of these."""
        is_used = np.zeros(len(self._vertices_mm), bool)
        is_used[edges] = True
        return np.flatnonzero(is_used), (np.cumsum(is_used) - 1)[edges]
