import shutil

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.demo import frames as demo_frames
from ExpectedAppearancesLib.demo.frames import write_unseen_frames
from ExpectedAppearancesLib.demo.phantom import make_phantom, write_sample_frames
from ExpectedAppearancesLib.demo.vessel_tree import demo_camera, generate_case_meshes, generate_tree, tree_mesh
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy
from ExpectedAppearancesLib.registration.poses_file import read_poses
from ExpectedAppearancesLib.registration.predictor import FORMAT_VERSION, Predictor


@pytest.fixture(scope="module")
def tree():
    return generate_tree(0)


@pytest.fixture(scope="module")
def meshes(tree):
    patch, branches = tree
    return tree_mesh(patch, branches), patch.mesh()


def children_of(branches, index):
    return [b for b in branches if b.parent == index]


def test_every_branching_keeps_murrays_law(tree):
    branches = tree[1]
    branchings = 0
    for i, branch in enumerate(branches):
        children = children_of(branches, i)
        assert len(children) in (0, 2)
        if children:
            branchings += 1
            assert branch.radius_mm**3 == pytest.approx(sum(c.radius_mm**3 for c in children))
            for child in children:
                np.testing.assert_array_equal(child.centre_line_mm[0], branch.centre_line_mm[-1])
    assert branchings >= 4
    assert all(0.5 <= b.radius_mm <= 1.5 for b in branches)


def test_roots_enter_at_the_border_and_nothing_leaves_the_patch(tree):
    branches = tree[1]
    roots = [b for b in branches if b.parent is None]
    assert len(roots) >= 2
    for root in roots:
        assert np.abs(root.centre_line_mm[0]).max() == pytest.approx(22.0)
    assert max(np.abs(b.centre_line_mm).max() for b in branches) <= 22.0 + 1e-9


def test_vessels_lie_on_the_cortex_partly_sunk(tree, meshes):
    patch, branches = tree
    cortex = cKDTree(meshes[1].vertices_mm)
    mesh_vertices = meshes[0].vertices_mm
    for branch in branches:
        points = patch.to_world(branch.centre_line_mm)
        # The grid's own spacing is 0.55 mm: its nearest vertex is at most 0.4 mm aside.
        assert cortex.query(points)[0].max() < min(branch.radius_mm, 0.45)
        # The wall stands `radius` away from a line that lies 0.3 radii above the surface.
        middle = points[len(points) // 2]
        near = mesh_vertices[np.linalg.norm(mesh_vertices - middle, axis=1) < 1.35 * branch.radius_mm]
        heights = (near - middle) @ patch.outward_axis
        assert heights.min() < -0.4 * branch.radius_mm
        assert heights.max() > 1.0 * branch.radius_mm


def test_tubes_are_closed_outward_and_as_thick_as_their_radius(tree, meshes):
    vessels = meshes[0]
    assert np.isfinite(vessels.vertices_mm).all()
    assert len(vessels.vertices_mm) <= 15_000
    assert set(vessels.triangles.ravel()) == set(range(len(vessels.vertices_mm)))
    a, b, c = vessels.triangles.T
    directed = np.concatenate([np.stack(pair, 1) for pair in ((a, b), (b, c), (c, a))])
    assert len(np.unique(directed, axis=0)) == len(directed)
    # Every edge is used by exactly two triangles, which run along it in opposite directions.
    assert {tuple(e) for e in directed} == {tuple(e[::-1]) for e in directed}
    corners = vessels.vertices_mm[vessels.triangles]
    volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
    expected = 0.0
    for branch in tree[1]:
        line = tree[0].to_world(branch.centre_line_mm)
        length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
        expected += np.pi * branch.radius_mm**2 * (length + 4 / 3 * branch.radius_mm)
    assert volume == pytest.approx(expected, rel=0.08)


def test_the_same_seed_repeats_and_another_differs(tree, meshes):
    again = generate_case_meshes(0)
    for first, second in zip(meshes, again, strict=True):
        np.testing.assert_array_equal(first.vertices_mm, second.vertices_mm)
        np.testing.assert_array_equal(first.triangles, second.triangles)
    other_patch, other_branches = generate_tree(1)
    assert len(other_branches) >= 6
    # Compared in the patch, where place and direction in the head play no part.
    first_lines = np.vstack([b.centre_line_mm for b in tree[1]])
    other_lines = np.vstack([b.centre_line_mm for b in other_branches])
    assert np.median(cKDTree(first_lines).query(other_lines)[0]) > 0.5
    assert np.isfinite(other_patch.mesh().vertices_mm).all()


@pytest.mark.parametrize("with_cortex", [True, False])
def test_the_craniotomy_is_found(tree, meshes, with_cortex):
    vessels, cortex = meshes
    found = find_craniotomy(vessels, cortex if with_cortex else None)
    assert found.outward_axis @ tree[0].outward_axis > np.cos(np.radians(10))
    assert np.abs(tree[0].outward_axis).max() < 0.95


def test_frames_show_what_the_label_maps_say(tree, meshes, tmp_path, monkeypatch):
    monkeypatch.setattr(demo_frames, "FINE_TRIANGLES", 10_000)  # coarser colours, in a fraction of the time
    vessels, cortex = meshes
    camera, patch = demo_camera(), tree[0]
    assert (camera.width, camera.height) == (256, 256)
    target = patch.centre_world_mm
    poses = np.stack(
        [
            look_at(target + 115 * patch.outward_axis + side * patch.axes[0], target, patch.axes[1])
            for side in (-40.0, 0.0, 40.0)
        ]
    )
    path = write_unseen_frames(tmp_path / "frames", vessels, cortex, camera, poses, styles=2, seed=5)
    read_camera, frames = read_poses(path)
    assert read_camera.without_distortion() == camera
    assert [f.style for f in frames] == ["unseen-1", "unseen-1", "unseen-2"]
    colours = []
    with MaskRenderer(vessels, cortex, camera) as renderer:
        for frame, pose in zip(frames, poses, strict=True):
            np.testing.assert_allclose(frame.camera_from_world, pose)
            image = files.read_image_rgb(frame.image).astype(float)
            assert image.shape == (256, 256, 3)
            labels = renderer.render(frame.camera_from_world)
            inner = {k: cv2.erode((labels == k).astype(np.uint8), np.ones((3, 3))) > 0 for k in range(3)}
            assert image[cv2.erode((labels == 0).astype(np.uint8), np.ones((9, 9))) > 0].max() <= 12
            parenchyma, vessel = (np.median(image[inner[k]], axis=0) for k in (1, 2))
            assert np.linalg.norm(parenchyma - vessel) > 40
            nearer_vessel = np.linalg.norm(image - vessel, axis=2) < np.linalg.norm(image - parenchyma, axis=2)
            # Pixel by pixel, so a frame that is mirrored or shifted fails.
            assert nearer_vessel[inner[2]].mean() > 0.8
            assert nearer_vessel[inner[1]].mean() < 0.25
            colours.append(np.concatenate([parenchyma, vessel]))
    assert np.abs(colours[0] - colours[1]).max() < 25
    assert np.linalg.norm(colours[1] - colours[2]) > 20


def test_a_phantom_kept_since_before_an_update_gets_the_model_of_this_version(tmp_path):
    made = make_phantom(tmp_path / "case")
    path = made.case.model_folder / "model.json"
    files.write_json(path, files.read_json(path, "model") | {"format_version": FORMAT_VERSION - 1})
    with pytest.raises(InputError, match="older version"):
        Predictor(made.case.model_folder)
    make_phantom(tmp_path / "case")
    Predictor(made.case.model_folder)


def test_no_command_registers_with_a_model_of_other_vessels(tmp_path, capsys):
    """Copied into the wrong patient's case, it would accept its own patient's frames, for the wrong mesh."""
    own, other = make_phantom(tmp_path / "own"), make_phantom(tmp_path / "other", seed=1)
    frames = write_sample_frames(own, tmp_path / "frames", 2)
    shutil.rmtree(other.case.model_folder)
    shutil.copytree(own.case.model_folder, other.case.model_folder)
    for case, code in ((own.case, 0), (other.case, 2)):
        folder, out = str(case.folder), tmp_path / "out"
        assert main(["register", folder, str(frames.parent / "000.png"), "--out", str(out / "p.json")]) == code
        assert main(["evaluate", folder, "--poses", str(frames), "--out", str(out)]) == code
    assert capsys.readouterr().err.count("trained on the vessels of another case") == 2
