from __future__ import annotations

import numpy as np
import pytest

from ExpectedAppearancesLib.augmentation import elastic
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at, pose_from_rotation, rotation_matrix


def best_fit_affine_motion_px(field_px):
    """Displacements (H*W, 2) of the least-squares best-fit affine, by a solver that knows nothing of the projection."""
    height, width = field_px.shape[:2]
    design = np.array([[1.0, x, y] for y in range(height) for x in range(width)])
    targets = field_px.reshape(-1, 2).astype(float)
    return design @ np.linalg.lstsq(design, targets, rcond=None)[0]


@pytest.mark.parametrize("shape_hw", [(128, 128), (48, 90), (7, 5)])
@pytest.mark.parametrize("smoothness_px", [4.0, 24.0, 500.0])
def test_field_has_no_affine_part_but_bends(shape_hw, smoothness_px):
    field = elastic.displacement_field(shape_hw, 9.0, smoothness_px, np.random.default_rng(3))
    assert field.shape == (*shape_hw, 2) and field.dtype == np.float32
    assert np.linalg.norm(best_fit_affine_motion_px(field), axis=1).max() < 1e-3
    assert np.linalg.norm(field, axis=2).max() == pytest.approx(9.0, rel=1e-4)


def test_the_affine_part_of_any_field_is_removed_and_only_that():
    y, x = np.mgrid[:40, :60].astype(float)
    affine = np.stack([3 + 0.1 * x - 0.2 * y, -5 + 0.05 * x + 0.3 * y], -1)
    bend = elastic.displacement_field((40, 60), 2.0, 12.0, np.random.default_rng(0))
    np.testing.assert_allclose(elastic.without_affine_part(affine), 0, atol=1e-9)
    np.testing.assert_allclose(elastic.without_affine_part(affine + bend), bend, atol=1e-5)


def test_field_is_smooth_does_not_fold_and_repeats_by_seed():
    field = elastic.displacement_field((96, 96), 5.0, 24.0, np.random.default_rng(7))
    dx_dy, dx_dx = np.gradient(field[..., 0].astype(float))
    dy_dy, dy_dx = np.gradient(field[..., 1].astype(float))
    assert ((1 + dx_dx) * (1 + dy_dy) - dx_dy * dy_dx).min() > 0
    assert np.abs(np.diff(field, axis=0)).max() < 1.5
    again = elastic.displacement_field((96, 96), 5.0, 24.0, np.random.default_rng(7))
    other = elastic.displacement_field((96, 96), 5.0, 24.0, np.random.default_rng(8))
    assert (field == again).all() and not np.allclose(field, other)


def test_warp_fetches_each_pixel_from_where_the_field_points():
    image = np.random.default_rng(0).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    field = np.zeros((20, 30, 2), np.float32)
    field[..., 0], field[..., 1] = 3, -2
    warped = elastic.warp(image, field)
    np.testing.assert_array_equal(warped[2:, :27], image[:18, 3:])


def test_no_amplitude_no_displacement_and_nonsense_is_refused():
    assert not elastic.displacement_field((16, 16), 0.0, 8.0, np.random.default_rng(0)).any()
    for shape_hw, amplitude, smoothness in (((3, 16), 1, 8), ((16, 16), -1, 8), ((16, 16), 1, 0)):
        with pytest.raises(ValueError):
            elastic.displacement_field(shape_hw, amplitude, smoothness, np.random.default_rng(0))


def test_nearest_pose_is_found_and_stays_where_too_little_is_seen():
    """A tilted plane far from the origin, off-centre camera: where each cell's ray meets it is worked out by hand."""
    camera = Camera(128, 128, 240.0, 250.0, 70.0, 58.0)
    middle = np.array([900.0, -400.0, 300.0])
    true = look_at(np.array([930.0, -380.0, 390.0]), middle, np.array([0, 1.0, 0]))
    cells_px = (np.stack(np.meshgrid(np.arange(32), np.arange(32)), axis=-1) + 0.5) * 4 - 0.5
    rays = np.concatenate([(cells_px - [70.0, 58.0]) / [240.0, 250.0], np.ones((32, 32, 1))], axis=-1) @ true[:3, :3]
    eye = -true[:3, :3].T @ true[:3, 3]
    points_mm = eye + rays * ((middle - eye)[2] / rays[..., 2:])
    start = pose_from_rotation(rotation_matrix(np.array([0.02, -0.01, 0.03])), np.array([1.0, -2.0, 3.0])) @ true
    surface = np.zeros((32, 32), np.uint8)
    surface[4:30, 2:20] = 1
    found = elastic.nearest_pose(start, points_mm.astype(np.float32), surface, camera)
    np.testing.assert_allclose(found, true, atol=2e-3)
    surface[8:] = 0
    surface[:, 10:] = 0
    assert elastic.nearest_pose(start, points_mm, surface, camera) is start
