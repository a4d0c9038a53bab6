"""The vessels' outline is brought onto the edges of the frame itself."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from cases import dome, vessels
from test_refinement import CAMERA, CORTEX, EXPOSED, MESH, TRUE, disturbed, error_mm, fit_at

from ExpectedAppearancesLib.case.meshes import Mesh
from ExpectedAppearancesLib.geometry.pose import look_at
from ExpectedAppearancesLib.geometry.silhouette import Silhouette
from ExpectedAppearancesLib.masks.exposed import exposed_vessels
from ExpectedAppearancesLib.masks.labels import BACKGROUND, PARENCHYMA, VESSELS
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.registration.contrast import NEAR_PX, ContrastAligner
from ExpectedAppearancesLib.registration.refinement import VesselAligner

SHARP = CAMERA.resized(256, 256)


@pytest.fixture(scope="module")
def labels() -> np.ndarray:
    with MaskRenderer(MESH, CORTEX, SHARP.resized(1024, 1024)) as renderer:
        return renderer.render(TRUE)


def frame(labels: np.ndarray, vessel_rgb, cortex_rgb, noise: float = 6.0, seed: int = 0) -> np.ndarray:
    """Flat colours, light that falls off by half from one corner to the other, noise, and black around."""
    rng = np.random.default_rng(seed)
    image = np.zeros((*labels.shape, 3), np.float32)
    image[labels == PARENCHYMA], image[labels == VESSELS] = cortex_rgb, vessel_rgb
    image = cv2.resize(image, (256, 256), interpolation=cv2.INTER_AREA)
    y, x = np.mgrid[:256, :256] / 255
    image *= (1 - 0.25 * x - 0.25 * y)[..., None].astype(np.float32)
    image += rng.normal(0, noise, image.shape) * (image.sum(axis=2, keepdims=True) > 30)
    return np.clip(image, 0, 255).astype(np.uint8)


def aligned(start: np.ndarray, image: np.ndarray):
    return ContrastAligner(EXPOSED.vertices_mm, EXPOSED.triangles, SHARP).align(fit_at(start), image)


@pytest.mark.parametrize("colours", [((110, 40, 60), (215, 150, 130)), ((190, 180, 200), (160, 110, 100))])
@pytest.mark.parametrize("seed", range(3))
def test_a_pose_that_is_off_is_brought_back_whatever_the_colours(labels, colours, seed):
    """Dark vessels on a light cortex and, in another light, pale ones on a darker one."""
    start = disturbed(seed, 0.8, (0.4, 0.4, 1.5))
    found = aligned(start, frame(labels, *colours, seed=seed))
    assert error_mm(start) > 1.2 and error_mm(found.fit.camera_from_world) < 0.3
    assert found.matched > 0.6 and found.residual_px < 0.8 and found.separation > 1
    assert found.moved_mm > 0.5


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_a_pose_that_is_far_off_is_brought_back(labels, seed):
    """Farther than edges are sought at first: vessels that lie side by side are then taken for each other."""
    start = disturbed(seed, 3.0, (1.5, 1.5, 4.0))
    found = aligned(start, frame(labels, (110, 40, 60), (215, 150, 130), seed=seed))
    assert error_mm(start) > 4.5 and error_mm(found.fit.camera_from_world) < 0.3
    assert found.matched > 0.7


def test_a_true_pose_stays(labels):
    found = aligned(TRUE, frame(labels, (110, 40, 60), (215, 150, 130)))
    assert error_mm(found.fit.camera_from_world) < 0.2 and found.moved_mm < 0.5


def test_where_no_vessel_shows_little_matches(labels):
    rng = np.random.default_rng(3)
    pattern = cv2.GaussianBlur(rng.normal(0, 1, (256, 256, 3)), (0, 0), 3)
    nothing = np.clip((170, 120, 110) + 200 * pattern, 20, 255).astype(np.uint8)
    true, none = aligned(TRUE, frame(labels, (110, 40, 60), (215, 150, 130))), aligned(TRUE, nothing)
    assert none.separation < 0.4 * true.separation
    assert none.residual_px > 2 * true.residual_px


def test_a_black_frame_changes_nothing():
    found = aligned(TRUE, np.zeros((256, 256, 3), np.uint8))
    np.testing.assert_array_equal(found.fit.camera_from_world, TRUE)
    assert (found.matched, found.residual_px, found.separation, found.moved_mm) == (0.0, NEAR_PX, 0.0, 0.0)


def test_vessels_that_are_seen_from_behind_change_nothing():
    """So a mirrored picture is explained. Of vessels that are open below no outline is left there, at which every frame
    ended in OpenCV's own error."""
    sunk = Mesh(vessels().vertices_mm - [0, 0, 0.8], vessels().triangles)
    part = exposed_vessels(sunk, dome(), np.array([0, 0, 1.0]))
    behind = fit_at(look_at(np.array([0, 0, -100.0]), np.zeros(3), np.array([0, 1.0, 0])))
    by_vessels = VesselAligner(part.vertices_mm, part.triangles, CAMERA).align(behind, *np.ones((2, 64, 64)))
    by_frame = ContrastAligner(part.vertices_mm, part.triangles, SHARP).align(
        behind, np.full((256, 256, 3), 128, np.uint8)
    )
    for found in (by_vessels, by_frame):
        np.testing.assert_array_equal(found.fit.camera_from_world, behind.camera_from_world)
        assert (found.matched, found.moved_mm) == (0.0, 0.0)


def test_covariance_grows_where_half_of_the_vessels_are_covered(labels):
    image = frame(labels, (110, 40, 60), (215, 150, 130))
    covered = image.copy()
    covered[:, :128] = 0
    whole, half = aligned(TRUE, image).fit.covariance, aligned(TRUE, covered).fit.covariance
    assert np.trace(half) > np.trace(whole) > 0


def test_the_inside_of_an_outline_is_where_the_surface_is_drawn(labels):
    """Between each edge and its third vertex a vessel is seen, unless something lies in front."""
    edges, inner = Silhouette(EXPOSED.vertices_mm, EXPOSED.triangles).edges_with_inside(TRUE)
    expected = Silhouette(EXPOSED.vertices_mm, EXPOSED.triangles).edges(TRUE, facing_borders_only=True)
    np.testing.assert_array_equal(edges, expected)
    assert (inner != edges[:, 0]).all() and (inner != edges[:, 1]).all()
    middles = 0.5 * EXPOSED.vertices_mm[edges].mean(axis=1) + 0.5 * EXPOSED.vertices_mm[inner]
    pixels = SHARP.resized(1024, 1024).project(middles @ TRUE[:3, :3].T + TRUE[:3, 3])
    columns, rows = np.rint(pixels).astype(int).T
    seen = labels[rows.clip(0, 1023), columns.clip(0, 1023)]
    assert (seen == VESSELS).mean() > 0.85 and (seen == BACKGROUND).mean() < 0.02
