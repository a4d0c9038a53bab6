"""The generated case: Murray's law, closed meshes, vessels on the cortex, repeatable by seed."""

from __future__ import annotations

import numpy as np
import pytest

from ExpectedAppearancesLib.demo import vessel_tree


@pytest.fixture(scope="module")
def tree():
    return vessel_tree.generate_tree(0)


@pytest.fixture(scope="module")
def meshes():
    return vessel_tree.generate_case_meshes(0)


def in_patch(patch, points_world_mm: np.ndarray) -> np.ndarray:
    """World points in the patch's own coordinates, z outwards."""
    return (points_world_mm - patch.centre_world_mm) @ np.asarray(patch.axes).T


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_murrays_law_and_continuity_at_every_branching(seed):
    _, branches = vessel_tree.generate_tree(seed)
    branchings = {branch.parent for branch in branches} - {None}
    assert branchings
    assert sum(branch.parent is None for branch in branches) >= 2
    for index in branchings:
        children = [branch for branch in branches if branch.parent == index]
        assert len(children) == 2
        assert sum(child.radius_mm**3 for child in children) == pytest.approx(branches[index].radius_mm ** 3, rel=1e-9)
        for child in children:
            np.testing.assert_allclose(child.centre_line_mm[0], branches[index].centre_line_mm[-1], atol=1e-9)


def test_branches_are_tortuous_superficial_veins(tree):
    _, branches = tree
    assert all(0.4 <= branch.radius_mm <= 1.5 for branch in branches)
    lengths = [np.linalg.norm(np.diff(b.centre_line_mm, axis=0), axis=1).sum() for b in branches]
    chords = [np.linalg.norm(b.centre_line_mm[-1] - b.centre_line_mm[0]) for b in branches]
    assert sum(lengths) / sum(chords) > 1.02


@pytest.mark.parametrize("seed", [0, 3])
def test_vessels_are_closed_consistently_turned_outward_and_small_enough(seed):
    vessels, _ = vessel_tree.generate_case_meshes(seed)
    assert np.isfinite(vessels.vertices_mm).all()
    assert 2000 < len(vessels.vertices_mm) <= 15000
    t = vessels.triangles
    directed = np.concatenate([t[:, [0, 1]], t[:, [1, 2]], t[:, [2, 0]]])
    edges, counts = np.unique(directed, axis=0, return_counts=True)
    known = set(map(tuple, edges.tolist()))
    assert (counts == 1).all() and all((b, a) in known for a, b in known)
    a, b, c = (vessels.vertices_mm[t[:, i]] - vessels.centroid_mm for i in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0


def test_vessels_touch_the_cortex_and_are_partly_sunk_into_it(tree, meshes):
    patch, _ = tree
    vessels, cortex = (in_patch(patch, mesh.vertices_mm) for mesh in meshes)
    inside = np.abs(vessels[:, :2]).max(axis=1) < np.abs(cortex[:, :2]).max() - 1.0
    sample = vessels[inside][::10]
    nearest = [np.argmin(((cortex[:, :2] - vertex[:2]) ** 2).sum(axis=1)) for vertex in sample]
    above_mm = sample[:, 2] - cortex[nearest, 2]
    assert 0.3 < (above_mm > 0).mean() < 0.8
    assert np.abs(above_mm).max() < 3.0


def test_the_cortex_faces_outwards(tree, meshes):
    assert (meshes[1].vertex_normals() @ tree[0].outward_axis).min() > 0.3


def test_same_seed_same_case_and_another_seed_another(meshes):
    vessels, cortex = vessel_tree.generate_case_meshes(0)
    np.testing.assert_array_equal(vessels.vertices_mm, meshes[0].vertices_mm)
    np.testing.assert_array_equal(cortex.vertices_mm, meshes[1].vertices_mm)
    other, _ = vessel_tree.generate_case_meshes(1)
    assert other.vertices_mm.shape != vessels.vertices_mm.shape or not np.allclose(
        other.vertices_mm, vessels.vertices_mm
    )


def test_no_quarter_turn_makes_the_tree_look_the_same(tree, meshes):
    vessels = in_patch(tree[0], meshes[0].vertices_mm)[:, :2]
    for degrees in (90, 180, 270):
        turn = np.radians(degrees)
        turned = vessels @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        gaps = np.linalg.norm(turned[::20, None] - vessels[None, ::5], axis=2).min(axis=1)
        assert gaps.mean() > 1.0  # mm; the vessels are 1 to 3 mm wide
