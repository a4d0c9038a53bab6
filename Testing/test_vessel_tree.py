"""The generated case: Murray's law, closed meshes, vessels on the cortex, repeatable by seed."""

from __future__ import annotations

import numpy as np
import pytest

from ExpectedAppearancesLib.demo import vessel_tree
from ExpectedAppearancesLib.geometry.pose import inverse, transform


@pytest.fixture(scope="module")
def tree():
    rng = np.random.default_rng([0, 1])
    surface = vessel_tree.CortexSurface(rng)
    return surface, vessel_tree.grow_tree(surface, rng)


@pytest.fixture(scope="module")
def meshes():
    return vessel_tree.generate_case_meshes(0)


def edge_counts(triangles: np.ndarray) -> dict[tuple[int, int], int]:
    directed = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges, counts = np.unique(directed, axis=0, return_counts=True)
    return dict(zip(map(tuple, edges.tolist()), counts.tolist()))


def test_murrays_law_and_continuity_at_every_branching(tree):
    _, segments = tree
    branchings = {segment.parent for segment in segments} - {-1}
    assert len(branchings) >= 3
    assert sum(segment.parent == -1 for segment in segments) >= 2
    for index in branchings:
        children = [segment for segment in segments if segment.parent == index]
        assert len(children) == 2
        parent_end_mm = segments[index].radii_mm[-1]
        assert sum(child.radii_mm[0] ** 3 for child in children) == pytest.approx(parent_end_mm**3, rel=1e-9)
        for child in children:
            np.testing.assert_allclose(child.points_mm[0], segments[index].points_mm[-1], atol=1e-9)


def test_murrays_angles_of_a_symmetric_branching():
    # Equal children: cos = 2^(-1/3) from 4^(1/3) / 2, that is 37.5 degrees (Murray 1926).
    radii = vessel_tree.children_radii_mm(1.0, 1.0)
    assert radii == pytest.approx((0.5 ** (1 / 3),) * 2)
    assert np.degrees(vessel_tree.branching_angle_rad(1.0, *radii)) == pytest.approx(37.467, abs=0.01)


def test_segments_are_tortuous_tapering_superficial_veins(tree):
    _, segments = tree
    for segment in segments:
        assert (np.diff(segment.radii_mm) < 0).all()
        assert 0.39 <= segment.radii_mm.min() <= segment.radii_mm.max() <= 1.5
    lengths = [np.linalg.norm(np.diff(s.points_mm, axis=0), axis=1).sum() for s in segments]
    chords = [np.linalg.norm(s.points_mm[-1] - s.points_mm[0]) for s in segments]
    assert sum(lengths) / sum(chords) > 1.03


@pytest.mark.parametrize("seed", [0, 3])
def test_vessels_are_closed_consistently_turned_outward_and_small_enough(seed):
    vessels, _ = vessel_tree.generate_case_meshes(seed)
    assert np.isfinite(vessels.vertices_mm).all()
    assert 2000 < len(vessels.vertices_mm) <= 15000
    edges = edge_counts(vessels.triangles)
    assert all(count == 1 and edges.get((b, a)) == 1 for (a, b), count in edges.items())
    a, b, c = (vessels.vertices_mm[vessels.triangles[:, i]] for i in range(3))
    assert np.einsum("ij,ij->", a - vessels.centroid_mm, np.cross(b - a, c - a)) > 0


def test_the_skin_lies_at_the_radius_from_the_centrelines(tree, meshes):
    _, segments = tree
    points = np.concatenate([s.points_mm for s in segments])
    radii = np.concatenate([s.radii_mm for s in segments])
    skin = transform(inverse(vessel_tree.world_from_patch(0)), meshes[0].vertices_mm)[::7]
    to_wall = np.linalg.norm(skin[:, None] - points[None], axis=2) - radii[None]
    assert np.abs(to_wall.min(axis=1)).max() < 0.1


def test_vessels_lie_half_sunk_on_the_cortex(meshes):
    vessels, cortex = (transform(inverse(vessel_tree.world_from_patch(0)), mesh.vertices_mm) for mesh in meshes)
    assert np.ptp(cortex[:, :2], axis=0) == pytest.approx([45.0, 45.0])
    nearest = [np.argmin(((cortex[:, :2] - vertex[:2]) ** 2).sum(axis=1)) for vertex in vessels[::10]]
    above_mm = vessels[::10, 2] - cortex[nearest, 2]
    assert 0.35 < (above_mm > 0).mean() < 0.65
    assert np.abs(above_mm).max() < 3.0


def test_the_cortex_faces_outwards(meshes):
    _, cortex = meshes
    outward = vessel_tree.world_from_patch(0)[:3, 2]
    assert (cortex.vertex_normals() @ outward).min() > 0.3


def test_same_seed_same_case_and_another_seed_another(meshes):
    vessels, cortex = vessel_tree.generate_case_meshes(0)
    np.testing.assert_array_equal(vessels.vertices_mm, meshes[0].vertices_mm)
    np.testing.assert_array_equal(cortex.vertices_mm, meshes[1].vertices_mm)
    other, _ = vessel_tree.generate_case_meshes(1)
    assert len(other.vertices_mm) != len(vessels.vertices_mm)


def test_the_tree_has_no_second_pose_that_looks_the_same(meshes):
    vessels = transform(inverse(vessel_tree.world_from_patch(0)), meshes[0].vertices_mm)[:, :2]
    for degrees in (90, 180, 270):
        turn = np.radians(degrees)
        turned = vessels @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        gaps = np.linalg.norm(turned[::20, None] - vessels[None, ::5], axis=2).min(axis=1)
        assert gaps.mean() > 1.5  # mm; the vessels are 1 to 3 mm wide
