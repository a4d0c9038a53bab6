"""Live frames prepared so that A stays true, and what is drawn over them."""

from __future__ import annotations

import cases
import cv2
import numpy as np
import pytest

from ExpectedAppearancesLib.case.meshes import Mesh
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at, transform
from ExpectedAppearancesLib.live.frames import FramePreparation, FrameSettings, picture_box
from ExpectedAppearancesLib.live.overlay import OverlayMaker, winding

CAMERA = Camera(320, 240, 700.0, 690.0, 170.0, 108.0)
POSE = look_at(np.array([25.0, -18.0, 90.0]), np.array([1.0, 0.5, -2.0]), np.array([0.2, 1.0, 0.0]))


def noise(width=320, height=240, seed=0) -> np.ndarray:
    return np.random.default_rng(seed).integers(40, 255, (height, width, 3), dtype=np.uint8)


def projected_marks(camera, points_mm, radius=3) -> np.ndarray:
    """A frame of `camera` with bright discs where it sees the points; the rest dark grey."""
    image = np.full((camera.height, camera.width, 3), 60, np.uint8)
    for u, v in camera.project(points_mm):
        cv2.circle(image, (round(u * 16), round(v * 16)), radius * 16, (255, 255, 255), -1, cv2.LINE_AA, 4)
    return image


def seen_marks(image) -> np.ndarray:
    """Centres of the bright discs, px, by rows."""
    bright = np.clip(image[..., 1].astype(float) - 90, 0, None)
    _n, labels = cv2.connectedComponents((bright > 30).astype(np.uint8))
    ys, xs = np.mgrid[: image.shape[0], : image.shape[1]]
    found = []
    for label in range(1, labels.max() + 1):
        weight = bright * (cv2.dilate((labels == label).astype(np.uint8), np.ones((3, 3))) > 0)
        found.append([(xs * weight).sum() / weight.sum(), (ys * weight).sum() / weight.sum()])
    return np.array(sorted(found))


POINTS_MM = np.array([[-30, -22, 300], [-8, 15, 310], [12, -12, 295], [25, 18, 305.0]])


@pytest.mark.parametrize(
    "camera, settings, borders",
    [
        (Camera(640, 480, 1800, 1750, 340, 215), FrameSettings(longest_px=4000), None),
        (Camera(640, 480, 1800, 1750, 340, 215), FrameSettings(longest_px=333), None),
        (Camera(640, 480, 1800, 1750, 340, 215, (-2.0, 5.0, 0.003, -0.002, 0.0)), FrameSettings(longest_px=500), None),
        (Camera(640, 480, 1800, 1750, 340, 215), FrameSettings(crop_borders=True, longest_px=400), "kept"),
        (Camera(640, 480, 1800, 1750, 340, 215, (-2.0, 5.0, 0, 0, 0)), FrameSettings(crop_borders=True), "added"),
    ],
    ids=["as it is", "scaled", "undistorted", "borders in A", "borders not in A"],
)
def test_the_prepared_camera_sees_each_point_where_the_prepared_frame_has_it(camera, settings, borders):
    image = projected_marks(camera, POINTS_MM)
    if borders == "kept":  # calibrated with the black bars
        image[:, :70], image[:, -60:], image[:30] = 0, 0, 0
    elif borders == "added":  # calibrated without them
        image = cv2.copyMakeBorder(image, 0, 0, 120, 90, cv2.BORDER_CONSTANT, value=(0, 0, 0))
    prepared, ideal = FramePreparation(camera, settings).prepare(image)
    assert prepared.shape == (ideal.height, ideal.width, 3) and not ideal.is_distorted
    if borders == "kept":
        assert (ideal.width / ideal.height) == pytest.approx(510 / 450, rel=0.01)
    expected = ideal.project(POINTS_MM)
    inside = ((expected > 5) & (expected < [ideal.width - 6, ideal.height - 6])).all(axis=1)
    assert inside.sum() >= 3
    expected = np.array(sorted(expected[inside].tolist()))
    np.testing.assert_allclose(seen_marks(prepared), expected, atol=0.35)


def test_frames_that_come_upside_down_are_turned():
    image = noise()
    prepared, _camera = FramePreparation(CAMERA, FrameSettings(flip_rows=True)).prepare(image[::-1])
    np.testing.assert_array_equal(prepared, image)


def test_a_dark_moment_cuts_nothing_off():
    preparation = FramePreparation(CAMERA, FrameSettings(crop_borders=True))
    bright, dark = noise(), noise()
    bright[:, :40] = 0
    dark[:, :200] = 0
    assert preparation.prepare(bright)[1].width == 280
    assert preparation.prepare(dark)[1].width == 280
    assert picture_box(np.zeros((240, 320, 3), np.uint8)) == (0, 0, 320, 240)


def test_light_on_the_border_spoils_no_frame_after_it():
    """A menu or a flash over the black borders of a picture that the camera was calibrated without."""
    preparation = FramePreparation(CAMERA, FrameSettings(crop_borders=True))
    picture = noise()
    framed = cv2.copyMakeBorder(picture, 0, 0, 80, 60, cv2.BORDER_CONSTANT, value=(0, 0, 0))
    lit, dark = framed.copy(), framed.copy()
    lit[40:80, 10:50] = 200
    dark[:, :250] = 0
    for frame, fits in ((dark, False), (lit, False), (framed, True), (lit, False), (framed, True), (dark, True)):
        if fits:
            prepared, camera = preparation.prepare(frame)
            assert camera == CAMERA
            np.testing.assert_array_equal(prepared, frame[:, 80:400])
        else:
            with pytest.raises(InputError, match="aspect ratio"):
                preparation.prepare(frame)


@pytest.mark.parametrize(
    "image, words",
    [
        (np.zeros((240, 320, 3), np.float32), "float32"),
        (np.zeros((240, 320, 3), np.uint8), "blank"),
        (noise(320, 200), "aspect ratio"),
        (noise(20, 15), "at least"),
        (None, "NoneType"),
    ],
)
def test_what_is_no_picture_is_said(image, words):
    with pytest.raises(InputError, match=words):
        FramePreparation(CAMERA).prepare(image)


@pytest.mark.parametrize("is_whole", [True, False], ids=["whole", "cut open"])
def test_fill_is_the_same_as_opencv_fills_triangle_by_triangle(is_whole):
    """Of vessels that are cut open towards the camera one sees the inner side."""
    mesh = cases.vessels()
    if not is_whole:
        middle_mm = mesh.vertices_mm[mesh.triangles].mean(axis=1)
        mesh = Mesh(mesh.vertices_mm, mesh.triangles[(middle_mm[:, 0] < 5) | (_normals(mesh)[:, 2] < 0)])
    pose = POSE
    overlay = OverlayMaker(mesh).make(CAMERA, pose)
    pixels = CAMERA.project(transform(pose, mesh.vertices_mm))
    expected = np.zeros((240, 320), np.uint8)
    for triangle in pixels[mesh.triangles]:
        cv2.fillConvexPoly(expected, np.rint(triangle * 256).astype(int), 1, cv2.LINE_8, 8)
    # OpenCV also fills the pixels that a triangle's side only touches: a rim of one pixel.
    assert not (overlay.fill.astype(bool) & ~expected.astype(bool)).any()
    assert not (cv2.erode(expected, np.ones((3, 3))).astype(bool) & ~overlay.fill.astype(bool)).any()
    assert overlay.fill.sum() > 2000


def _normals(mesh) -> np.ndarray:
    a, b, c = mesh.vertices_mm[mesh.triangles].transpose(1, 0, 2)
    return np.cross(b - a, c - a)


def test_winding_counts_overlaps_and_cuts_what_lies_outside():
    square = np.array([[2, 1], [2, 6], [7, 6], [7, 1.0]])
    edges = np.stack([square, np.roll(square, -1, axis=0)], axis=1)
    shifted = edges + np.array([3.0, 2.0])
    both = winding(np.concatenate([edges, shifted]), np.ones(8), 9, 8)
    expected = np.zeros((8, 9), int)
    expected[1:6, 2:7] += 1
    expected[3:8, 5:10] += 1
    np.testing.assert_array_equal(np.abs(both), expected)
    np.testing.assert_array_equal(winding(edges - 20, np.ones(4), 9, 8), 0)


def test_nothing_is_drawn_of_vessels_behind_the_camera():
    assert OverlayMaker(cases.vessels()).make(CAMERA, np.diag([1.0, -1, -1, 1]) @ POSE) is None
