import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from cases import camera, dome, vessels

from ExpectedAppearancesLib.case.meshes import Mesh, read_mesh
from ExpectedAppearancesLib.geometry.camera import read_camera
from ExpectedAppearancesLib.geometry.pose import look_at, transform
from ExpectedAppearancesLib.masks.renderer import MaskRenderer

POSE = look_at(np.array([20.0, -30.0, 80.0]), np.zeros(3), np.array([0, -1.0, 0]))


@pytest.fixture(scope="module")
def renderer():
    with MaskRenderer(vessels(), dome(), camera()) as opened:
        yield opened


def painted(mesh: Mesh, pose: np.ndarray) -> np.ndarray:
    """Reference: every triangle projected by OpenCV and filled, no hidden-surface removal."""
    mask = np.zeros((camera().height, camera().width), np.uint8)
    pixels = camera().project(transform(pose, mesh.vertices_mm))
    for triangle in mesh.triangles:
        cv2.fillConvexPoly(mask, np.round(pixels[triangle] * 16).astype(int), 1, lineType=cv2.LINE_8, shift=4)
    return mask.astype(bool)


def test_masks_agree_with_projected_triangles(renderer):
    labels = renderer.render(POSE)
    assert set(np.unique(labels)) == {0, 1, 2}
    for drawn, expected in (
        (labels > 0, painted(dome(), POSE) | painted(vessels(), POSE)),
        (labels == 2, painted(vessels(), POSE)),
    ):
        # fillConvexPoly also paints the border pixel, so outlines may differ by one.
        core = cv2.erode(expected.astype(np.uint8), np.ones((3, 3)))
        rim = cv2.dilate(expected.astype(np.uint8), np.ones((3, 3)))
        assert drawn[core > 0].mean() > (0.9 if drawn.sum() < 2000 else 0.99)
        assert not drawn[rim == 0].any()


def test_vessels_behind_the_cortex_are_hidden():
    buried = Mesh(vessels().vertices_mm - [0, 0, 6.0], vessels().triangles)
    with MaskRenderer(buried, dome(), camera()) as renderer:
        labels = renderer.render(look_at(np.array([0, 0, 90.0]), np.zeros(3), np.array([0, -1.0, 0])))
    assert not (labels == 2).any() and (labels == 1).any()


def test_each_pixel_knows_its_depth_and_surface_point(renderer):
    labels, depth_mm, points = renderer.render_surface(POSE)
    rows, columns = np.nonzero(labels)
    seen = transform(POSE, points[rows, columns].astype(float))
    np.testing.assert_allclose(seen[:, 2], depth_mm[rows, columns], atol=1e-3)
    np.testing.assert_allclose(camera().project(seen), np.column_stack([columns, rows]), atol=2e-3)
    # The points of the dome lie on its formula.
    on_dome = points[labels == 1]
    expected = -4 * (on_dome[:, 0] ** 2 + on_dome[:, 1] ** 2) / 400
    assert np.abs(on_dome[:, 2] - expected).max() < 0.05
    assert not depth_mm[labels == 0].any()


def test_one_window_draws_any_number_of_poses(renderer):
    other = look_at(np.array([-25.0, 10.0, 95.0]), np.zeros(3), np.array([0.3, -1.0, 0]))
    first = renderer.render(POSE)
    assert (renderer.render(other) != first).any()
    np.testing.assert_array_equal(renderer.render(POSE), first)


def test_circular_field_keeps_a_circle_only():
    with MaskRenderer(vessels(), dome(200.0, 24, 1.0), camera(), circular_field=1 / 3) as renderer:
        labels = renderer.render(POSE)
    rows, columns = np.mgrid[0:96, 0:96]
    inside = np.hypot(rows - 47.5, columns - 47.5) <= 32
    assert (labels[inside] > 0).all() and not labels[~inside].any()


CORTEX = Path(__file__).parents[2] / "shared" / "data" / "cortex"


@pytest.mark.skipif(not CORTEX.is_dir(), reason="the real patient's case is not beside this checkout")
def test_real_frames_are_black_where_the_map_says_background():
    frames = json.loads((CORTEX / "poses.json").read_text(encoding="utf-8"))["frames"][::97]
    meshes = [read_mesh(CORTEX / f"{name}.vtp", name) for name in ("vessels", "cortex")]
    with MaskRenderer(*meshes, read_camera(CORTEX / "camera.json")) as renderer:
        for frame in frames:
            lit = cv2.imread(str(CORTEX / frame["image"]), cv2.IMREAD_GRAYSCALE) > 25
            surface = renderer.render(np.array(frame["camera_from_world"])) > 0
            # The patch was recovered from the frames: its rim is ragged.
            assert (lit & surface).sum() / (lit | surface).sum() > 0.85
