from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.geometry.silhouette import Silhouette

CENTRE_MM, RADIUS_MM = np.array([30.0, -12.0, 7.0]), 10.0


def sphere(rings: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Closed sphere of `rings` x 2 `rings` cells; triangles face outwards."""
    polar = np.linspace(0, np.pi, rings + 1)[1:-1, None]
    around = np.linspace(0, 2 * np.pi, 2 * rings, endpoint=False)[None]
    ring = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar) + 0 * around], -1)
    unit = np.vstack([ring.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    n, rows = 2 * rings, rings - 1
    top, bottom = len(unit) - 2, len(unit) - 1
    triangles = []
    for k in range(n):
        right = (k + 1) % n
        triangles += [(top, k, right), (bottom, (rows - 1) * n + right, (rows - 1) * n + k)]
        for r in range(rows - 1):
            a, b, c, d = r * n + k, r * n + right, (r + 1) * n + k, (r + 1) * n + right
            triangles += [(a, c, d), (a, d, b)]
    return CENTRE_MM + RADIUS_MM * unit, np.array(triangles)


@pytest.mark.parametrize("eye_mm", [(30.0, -12.0, 32.0), (55.0, 20.0, -18.0)])
def test_a_sphere_shows_the_circle_where_rays_touch_it(eye_mm):
    vertices, triangles = sphere()
    pose = look_at(np.array(eye_mm), CENTRE_MM, np.array([0.3, 1.0, 0.1]))
    distance = np.linalg.norm(CENTRE_MM - eye_mm)
    on_circle = vertices[Silhouette(vertices, triangles).edges(pose)].reshape(-1, 3) @ pose[2, :3] + pose[2, 3]
    # In perspective the rays touch in front of the middle, by r^2 / d; in parallel it would be the middle.
    np.testing.assert_allclose(on_circle, distance - RADIUS_MM**2 / distance, atol=1.2 * RADIUS_MM * np.pi / 60)

    points, lines = Silhouette(vertices, triangles).on_plane(pose, 50.0)
    np.testing.assert_allclose(points[:, 2], 50.0)
    touching = 50.0 * np.tan(np.arcsin(RADIUS_MM / distance))
    np.testing.assert_allclose(np.hypot(*points[:, :2].T), touching, rtol=0.01)
    assert lines.max() == len(points) - 1
    steps = np.linalg.norm(points[lines[:, 0]] - points[lines[:, 1]], axis=1)
    assert steps.sum() >= 0.98 * 2 * np.pi * touching, "the circle has gaps"


def test_an_open_surface_shows_its_border_and_no_inner_edge():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    silhouette = Silhouette(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    pose = look_at(np.array([0.5, 0.5, 9.0]), np.array([0.5, 0.5, 0.0]), np.array([0.0, 1.0, 0.0]))
    assert {tuple(edge) for edge in silhouette.edges(pose)} == {(0, 1), (1, 2), (2, 3), (0, 3)}


def test_what_lies_behind_the_camera_is_left_out():
    vertices, triangles = sphere()
    behind = look_at(CENTRE_MM + np.array([0, 0, 40]), CENTRE_MM + np.array([0, 0, 80]), np.array([0.0, 1.0, 0.0]))
    points, lines = Silhouette(vertices, triangles).on_plane(behind, 50.0)
    assert points.shape == (0, 3)
    assert lines.shape == (0, 2)


@pytest.mark.parametrize("kept", [1.0, 0.8], ids=["closed", "with holes"])
def test_boundary_goes_around_the_chosen_triangles_in_their_direction(kept):
    vertices, triangles = sphere(12)
    random = np.random.default_rng(1)
    triangles = triangles[random.random(len(triangles)) < kept]
    chosen = random.random(len(triangles)) < 0.5
    expected = Counter()
    for triangle in triangles[chosen].tolist():
        for first, second in zip(triangle, triangle[1:] + triangle[:1]):
            forwards = first < second
            expected[(first, second) if forwards else (second, first)] += 1 if forwards else -1
    silhouette = Silhouette(vertices, triangles)
    assert silhouette.is_closed == (kept == 1.0)
    edges, weight = silhouette.boundary(chosen)
    assert dict(zip(map(tuple, edges.tolist()), weight.tolist())) == {e: w for e, w in expected.items() if w}


def test_what_is_drawn_of_an_outline_has_its_own_numbers():
    vertices, triangles = sphere(12)
    silhouette = Silhouette(vertices, triangles)
    edges = silhouette.edges(look_at(np.array([55.0, 20.0, -18.0]), CENTRE_MM, np.array([0.3, 1.0, 0.1])))
    used, lines = silhouette.renumbered(edges)
    np.testing.assert_array_equal(used[lines], edges)
    assert sorted(set(edges.ravel().tolist())) == used.tolist()


def test_where_three_triangles_meet_the_edge_is_an_outline_unless_all_face_the_camera():
    vertices = np.array([[0, 0, 0], [0, 1, 0], [1, 0.5, 0.2], [-1, 0.5, 0.2], [0.2, 0.5, 1.0]], float)
    pose = look_at(np.array([0.1, 0.5, 9.0]), np.array([0.1, 0.5, 0.0]), np.array([0.0, 1.0, 0.0]))
    right, left, up = (0, 2, 1), (0, 1, 3), (0, 4, 1)  # all of them face the camera
    for third, expected in ((up, False), (up[::-1], True)):
        silhouette = Silhouette(vertices, np.array([right, left, third]))
        assert silhouette.towards(pose).tolist() == [True, True, not expected]
        assert ((0, 1) in map(tuple, silhouette.edges(pose).tolist())) == expected
        edges, within = silhouette.edges_with_inside(pose)
        assert dict(zip(map(tuple, edges.tolist()), within.tolist())).get((0, 1)) in ((2, 3) if expected else (None,))
