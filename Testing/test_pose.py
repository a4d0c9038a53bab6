"""Poses against scipy, cv2 and what VTK really draws."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from ExpectedAppearancesLib.geometry import pose
from ExpectedAppearancesLib.geometry.camera import Camera

CAMERA = Camera(320, 240, 500.0, 430.0, 120.0, 140.0)  # fx != fy, principal point off the centre


def random_pose(rng) -> np.ndarray:
    Rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    return pose.pose_from_rotation(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-100, 100, 3))


def test_inverse_and_transform_against_linear_algebra():
    rng = np.random.default_rng(0)
    poses = np.stack([random_pose(rng) for _ in range(5)])
    assert np.allclose(pose.inverse(poses), np.linalg.inv(poses))
    points = rng.normal(size=(7, 3))
    homogeneous = np.c_[points, np.ones(7)] @ poses[0].T
    assert np.allclose(pose.transform(poses[0], points), homogeneous[:, :3])


@pytest.mark.parametrize("angle_rad", [0.0, 1e-7, 0.3, 2.0, np.pi - 1e-4, np.pi])
def test_rotation_vector_and_angle_agree_with_scipy(angle_rad):
    Rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    axis = np.array([1.0, -2.0, 0.5])
    rotation = Rotation.from_rotvec(axis / np.linalg.norm(axis) * angle_rad)
    vector = pose.rotation_vector(rotation.as_matrix())
    assert np.linalg.norm(vector) == pytest.approx(angle_rad, abs=1e-6)
    assert np.allclose(Rotation.from_rotvec(vector).as_matrix(), rotation.as_matrix(), atol=1e-6)
    assert np.allclose(pose.rotation_matrix(rotation.as_rotvec()), rotation.as_matrix(), atol=1e-9)
    base = Rotation.from_euler("xyz", [0.4, -1.0, 2.0])
    angle = pose.geodesic_angle_rad((rotation * base).as_matrix(), base.as_matrix())
    assert angle == pytest.approx(angle_rad, abs=1e-9)


def test_geodesic_angle_of_many_rotations():
    Rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    first, second = (Rotation.random(20, random_state=seed) for seed in (1, 2))
    angles = pose.geodesic_angle_rad(first.as_matrix(), second.as_matrix())
    assert np.allclose(angles, (first * second.inv()).magnitude())


def test_is_rigid_refuses_what_is_not():
    rng = np.random.default_rng(3)
    good = random_pose(rng)
    assert pose.is_rigid(good)
    mirrored, scaled, skewed, lost = (good.copy() for _ in range(4))
    mirrored[:3, 0] *= -1
    scaled[:3, :3] *= 1.01
    skewed[3, 0] = 0.1
    lost[0, 3] = np.nan
    for bad in (mirrored, scaled, skewed, lost, good[:3]):
        assert not pose.is_rigid(bad)


def test_look_at_puts_target_ahead_and_up_upwards():
    centre, target, up = np.array([10.0, -200.0, 60.0]), np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.0, 1.0])
    camera_from_world = pose.look_at(centre, target, up)
    assert pose.is_rigid(camera_from_world)
    points = pose.transform(camera_from_world, np.stack([centre, target, target + up]))
    assert np.allclose(points[0], 0)
    assert np.allclose(points[1], [0, 0, np.linalg.norm(target - centre)])
    above = CAMERA.project(points[2:])[0]
    assert above[0] == pytest.approx(CAMERA.cx) and above[1] < CAMERA.cy  # y points down in the image


def test_opengl_pose_projects_to_the_same_pixel():
    """Textbook OpenGL: x_ndc = P x_eye with y up and z backward, then the viewport with y up from the lower edge."""
    rng = np.random.default_rng(4)
    camera_from_world = pose.look_at(np.array([10.0, -200.0, 60.0]), np.zeros(3), np.array([0.0, 0.1, 1.0]))
    world_from_camera = pose.opengl_world_from_camera(camera_from_world)
    points = rng.uniform(-20, 20, (10, 3))
    eye = np.linalg.inv(world_from_camera) @ np.c_[points, np.ones(10)].T
    assert (eye[2] < 0).all()  # OpenGL looks along -z
    u = CAMERA.fx * eye[0] / -eye[2] + CAMERA.cx
    v = -CAMERA.fy * eye[1] / -eye[2] + CAMERA.cy
    rotation_vector, translation_mm = pose.rotation_vector(camera_from_world[:3, :3]), camera_from_world[:3, 3]
    expected = cv2.projectPoints(points, rotation_vector, translation_mm, CAMERA.matrix, None)[0].reshape(-1, 2)
    assert np.allclose(np.stack([u, v], 1), expected)
    assert np.allclose(pose.camera_from_world_of_opengl(world_from_camera), camera_from_world)


def test_lps_and_ras_see_the_same_pixels():
    rng = np.random.default_rng(5)
    camera_from_lps = pose.look_at(np.array([10.0, -200.0, 60.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    points_lps = rng.uniform(-20, 20, (10, 3))
    points_ras = points_lps * [-1, -1, 1]  # left -> right, posterior -> anterior
    camera_from_ras = pose.flip_lps_ras(camera_from_lps)
    in_camera = pose.transform(camera_from_lps, points_lps)
    assert np.allclose(pose.transform(camera_from_ras, points_ras), in_camera)
    assert np.allclose(pose.flip_lps_ras(camera_from_ras), camera_from_lps)
    assert np.allclose(pose.transform(pose.camera_to_ras(camera_from_lps, "LPS"), in_camera), points_ras)
    assert np.allclose(pose.transform(pose.camera_to_ras(camera_from_ras, "RAS"), in_camera), points_ras)


def draw_spheres(points_world_mm, radius_mm, camera, camera_from_world) -> np.ndarray:
    """Image (H, W) of luminous spheres, row 0 at the top."""
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy

    renderer, window = vtk.vtkRenderer(), vtk.vtkRenderWindow()
    for point in points_world_mm:
        source, mapper, actor = vtk.vtkSphereSource(), vtk.vtkPolyDataMapper(), vtk.vtkActor()
        source.SetCenter(*point)
        source.SetRadius(radius_mm)
        source.SetThetaResolution(32)
        source.SetPhiResolution(32)
        mapper.SetInputConnection(source.GetOutputPort())
        actor.SetMapper(mapper)
        actor.GetProperty().LightingOff()
        renderer.AddActor(actor)
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(camera.width, camera.height)
    window.AddRenderer(renderer)
    pose.apply_to_vtk_camera(renderer.GetActiveCamera(), camera, camera_from_world, 10.0, 1000.0)
    window.Render()
    grab = vtk.vtkWindowToImageFilter()
    grab.SetInput(window)
    grab.ReadFrontBufferOff()
    grab.Update()
    pixels = vtk_to_numpy(grab.GetOutput().GetPointData().GetScalars())
    window.Finalize()
    return pixels.reshape(camera.height, camera.width, -1)[::-1, :, 0]


def test_vtk_draws_points_where_opencv_projects_them():
    camera_from_world = pose.look_at(
        np.array([40.0, -180.0, 90.0]), np.array([5.0, 0.0, 0.0]), np.array([0.3, 0.0, 1.0])
    )
    points = np.array([[0.0, 0, 0], [25, 8, -12], [-28, 5, 18], [10, -20, 25], [18, 30, 22], [-20, -10, -20]])
    image = draw_spheres(points, 1.2, CAMERA, camera_from_world)
    count, _, stats, centres = cv2.connectedComponentsWithStats((image > 127).astype(np.uint8))
    assert count - 1 == len(points)
    assert stats[1:, cv2.CC_STAT_AREA].min() >= 12
    rotation_vector, translation_mm = pose.rotation_vector(camera_from_world[:3, :3]), camera_from_world[:3, 3]
    expected = cv2.projectPoints(points, rotation_vector, translation_mm, CAMERA.matrix, None)[0].reshape(-1, 2)
    distance = np.linalg.norm(centres[1:, None] - expected[None], axis=2)
    assert sorted(distance.argmin(axis=1)) == list(range(len(points)))
    assert distance.min(axis=1).max() < 0.5
    # The mean over the spheres shows a shift of half a pixel that each alone would hide.
    nearest = expected[distance.argmin(axis=1)]
    assert np.abs((centres[1:] - nearest).mean(axis=0)).max() < 0.2
