"""Rigid poses as 4x4 matrices, and the only place where conventions are converted.

`camera_from_world` maps world mm to camera mm. Camera axes are OpenCV's (x right, y down, z forward) unless a name
says OpenGL (x right, y up, z backward; also NeRF's). World is the mesh files' coordinates; Slicer's world is RAS.
"""

from __future__ import annotations

import numpy as np

OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
RAS_FROM_LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def pose_from_rotation(rotation: np.ndarray, translation_mm: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, translation_mm
    return pose


def inverse(pose: np.ndarray) -> np.ndarray:
    """Inverse of rigid poses (..., 4, 4)."""
    rotation_t = np.swapaxes(pose[..., :3, :3], -1, -2)
    result = np.zeros_like(pose)
    result[..., :3, :3] = rotation_t
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation_t, pose[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def transform(pose: np.ndarray, points_mm: np.ndarray) -> np.ndarray:
    """(N, 3) points through one 4x4 pose."""
    return points_mm @ pose[:3, :3].T + pose[:3, 3]


def is_rigid(pose: np.ndarray, tolerance: float = 1e-3) -> bool:
    pose = np.asarray(pose, float)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return False
    rotation = pose[:3, :3]
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=tolerance) and np.linalg.det(rotation) > 0
    return bool(orthonormal and np.allclose(pose[3], [0, 0, 0, 1], atol=tolerance))


def rotation_vector(rotation: np.ndarray) -> np.ndarray:
    """3x3 rotation -> Euler-Rodrigues vector, rad (norm in [0, pi])."""
    import cv2

    return cv2.Rodrigues(np.ascontiguousarray(rotation, float))[0].ravel()


def rotation_matrix(rotation_vector_rad: np.ndarray) -> np.ndarray:
    """Euler-Rodrigues vector, rad -> 3x3 rotation."""
    import cv2

    return cv2.Rodrigues(np.asarray(rotation_vector_rad, float).reshape(3, 1))[0]


def geodesic_angle_rad(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle between rotations (..., 3, 3): arccos((tr(R1 R2^T) - 1) / 2), computed stably near 0 and pi."""
    relative = first @ np.swapaxes(second, -1, -2)
    cosine = (np.trace(relative, axis1=-2, axis2=-1) - 1) / 2
    skew = relative - np.swapaxes(relative, -1, -2)
    sine = np.linalg.norm(np.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1), axis=-1) / 2
    return np.arctan2(sine, cosine)


def mean_rotation(rotations: np.ndarray) -> np.ndarray:
    """The chordal mean (3, 3) of rotations (N, 3, 3): the rotation nearest to the mean of their matrices."""
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    return u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt


def look_at(centre_world_mm: np.ndarray, target_world_mm: np.ndarray, up_world: np.ndarray) -> np.ndarray:
    """camera_from_world of an OpenCV camera at `centre` that looks at `target` with `up_world` upwards in the image."""
    forward = np.asarray(target_world_mm, float) - centre_world_mm
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, up_world)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return pose_from_rotation(rotation, -rotation @ centre_world_mm)


def opengl_world_from_camera(camera_from_world: np.ndarray) -> np.ndarray:
    """OpenCV camera_from_world -> OpenGL / NeRF camera-to-world matrix (x right, y up, z backward)."""
    return inverse(np.asarray(camera_from_world, float)) @ OPENGL_FROM_OPENCV


def camera_from_world_of_opengl(world_from_camera_opengl: np.ndarray) -> np.ndarray:
    """OpenGL / NeRF camera-to-world matrix -> OpenCV camera_from_world."""
    return inverse(np.asarray(world_from_camera_opengl, float) @ OPENGL_FROM_OPENCV)


def flip_lps_ras(camera_from_world: np.ndarray) -> np.ndarray:
    """camera_from_world for a world in LPS -> the same pose for that world in RAS, or back."""
    return np.asarray(camera_from_world, float) @ RAS_FROM_LPS


def ras_from_world(world_space: str) -> np.ndarray:
    """4x4: mm of a world that is 'LPS' or 'RAS' -> Slicer's RAS mm; its own inverse."""
    return RAS_FROM_LPS if world_space == "LPS" else np.eye(4)


def camera_to_ras(camera_from_world: np.ndarray, world_space: str) -> np.ndarray:
    """Camera mm -> Slicer's RAS mm, from a pose whose world is 'LPS' or 'RAS'."""
    return ras_from_world(world_space) @ inverse(np.asarray(camera_from_world, float))


def apply_to_vtk_camera(vtk_camera, camera, camera_from_world: np.ndarray, near_mm: float, far_mm: float) -> None:
    """Make `vtk_camera` draw what `camera` (geometry.camera.Camera, distortion ignored) sees from the pose.

    The exact projection matrix is used rather than view angle and window centre, so fx != fy and an off-centre
    principal point hold. The render window must have camera.width x camera.height px.
    """
    import vtk

    world_from_camera = inverse(np.asarray(camera_from_world, float))
    centre, forward = world_from_camera[:3, 3], world_from_camera[:3, 2]
    vtk_camera.SetPosition(*centre)
    vtk_camera.SetFocalPoint(*(centre + forward * (near_mm + far_mm) / 2))
    vtk_camera.SetViewUp(*-world_from_camera[:3, 1])
    vtk_camera.SetClippingRange(near_mm, far_mm)
    width, height = camera.width, camera.height
    projection = vtk.vtkMatrix4x4()
    # Normalised device x = -1 is the left EDGE of the image, px -0.5; y points up.
    rows = (
        (2 * camera.fx / width, 0, -(2 * (camera.cx + 0.5) / width - 1), 0),
        (0, 2 * camera.fy / height, 2 * (camera.cy + 0.5) / height - 1, 0),
        (0, 0, -(far_mm + near_mm) / (far_mm - near_mm), -2 * far_mm * near_mm / (far_mm - near_mm)),
        (0, 0, -1, 0),
    )
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            projection.SetElement(i, j, value)
    vtk_camera.SetExplicitProjectionTransformMatrix(projection)
    vtk_camera.UseExplicitProjectionTransformMatrixOn()
