"""Label maps of the case from any pose, drawn off-screen by VTK in one window that is kept."""

from __future__ import annotations

import contextlib

import numpy as np
import vtk
from vtk.util.numpy_support import vtk_to_numpy

from ..case.meshes import Mesh
from ..geometry.camera import Camera
from ..geometry.pose import apply_to_vtk_camera, inverse, transform
from .labels import BACKGROUND, PARENCHYMA, VESSELS


def offscreen_window(width: int, height: int):
    """vtkRenderWindow of that size without blending of samples, on EGL or OSMesa where there is no display."""
    verbosity = vtk.vtkLogger.GetCurrentVerbosityCutoff()
    # Without a display VTK warns about the X server before it settles on EGL or OSMesa: no news to the user.
    vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_ERROR)
    try:
        window = vtk.vtkRenderWindow()
        window.SetOffScreenRendering(1)
        window.SetMultiSamples(0)  # blending at edges would invent labels
        window.SetSize(width, height)
        window.Render()
    finally:
        vtk.vtkLogger.SetStderrVerbosity(verbosity)
    return window


@contextlib.contextmanager
def others_context_kept(window):
    """Draw with `window`, which has been drawn before, in the block; then the OpenGL context that was current, such as
    that of a view of 3D Slicer, is current again. Without a display there is no other one."""
    can = hasattr(window, "PushContext") and hasattr(window, "PopContext") and not window.IsA("vtkEGLRenderWindow")
    if can:
        window.PushContext()
    try:
        yield
    finally:
        if can:
            window.PopContext()


class MaskRenderer:
    """Draws label maps: 0 background, 1 parenchyma, 2 vessels. Vessels behind the parenchyma are hidden.

    vessels, parenchyma: surfaces in world mm. camera: size and A of the maps; its distortion is ignored, since
    frames are undistorted. circular_field: keep only a circle of radius `circular_field` x height, the microscope's
    field (the authors use 1/3).
    Works with no display, on EGL or OSMesa. Not thread-safe; close it, or use it as a context manager.
    """

    _COLOUR_STEP = 100  # labels are drawn as grey 0, 100, 200: far apart, so that a driver's rounding cannot mix them
    _LABEL_OF_GREY = ((np.arange(256) + _COLOUR_STEP // 2) // _COLOUR_STEP).astype(np.uint8)

    def __init__(self, vessels: Mesh, parenchyma: Mesh, camera: Camera, circular_field: float | None = None):
        self.camera = camera.without_distortion()
        bounds = np.vstack([vessels.vertices_mm, parenchyma.vertices_mm])
        self._centre_mm = (bounds.min(axis=0) + bounds.max(axis=0)) / 2
        self._radius_mm = float(np.linalg.norm(bounds - self._centre_mm, axis=1).max()) * 1.01
        self._window = offscreen_window(camera.width, camera.height)
        self._renderer = vtk.vtkRenderer()
        self._renderer.SetBackground(0, 0, 0)
        self._renderer.UseFXAAOff()
        self._window.AddRenderer(self._renderer)
        for mesh, label in ((parenchyma, PARENCHYMA), (vessels, VESSELS)):
            mapper = vtk.vtkPolyDataMapper()
            mapper.SetInputData(mesh.to_polydata(normals=False))
            mapper.ScalarVisibilityOff()
            actor = vtk.vtkActor()
            actor.SetMapper(mapper)
            grey = label * self._COLOUR_STEP / 255
            actor.GetProperty().SetColor(grey, grey, grey)
            actor.GetProperty().LightingOff()
            self._renderer.AddActor(actor)
        self._pixels = vtk.vtkUnsignedCharArray()
        self._depths = vtk.vtkFloatArray()
        v, u = np.mgrid[0 : camera.height, 0 : camera.width]
        self._outside = None
        if circular_field is not None:
            middle_u, middle_v = (camera.width - 1) / 2, (camera.height - 1) / 2
            self._outside = np.hypot(u - middle_u, v - middle_v) > circular_field * camera.height
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
        self._rays = rays.astype(np.float32)

    def render(self, camera_from_world: np.ndarray) -> np.ndarray:
        """uint8 label map (H, W) from the pose."""
        with others_context_kept(self._window):
            self._draw(camera_from_world)
            return self._read_labels()

    def render_surface(self, camera_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Labels uint8 (H, W); depth along the optical axis, mm, float32 (H, W), 0 where nothing is;
        and the surface point seen by each pixel, world mm, float32 (H, W, 3), 0 where nothing is."""
        with others_context_kept(self._window):
            near, far = self._draw(camera_from_world)
            labels = self._read_labels()
            height, width = labels.shape
            self._window.GetZbufferData(0, 0, width - 1, height - 1, self._depths)
        import cv2  # not at the top: label maps alone are drawn where it is not installed

        z = cv2.flip(vtk_to_numpy(self._depths).reshape(height, width), 0)
        # What has no label is left out by the masks.
        depth_mm = cv2.copyTo(np.float32(far * near) / (np.float32(far) - z * np.float32(far - near)), labels)
        world_from_camera = inverse(np.asarray(camera_from_world, float))
        # Single precision is good for a micrometre here, and many times faster.
        rays_mm = cv2.multiply(self._rays, cv2.merge([depth_mm] * 3))
        points = cv2.copyTo(cv2.transform(rays_mm, world_from_camera[:3].astype(np.float32)), labels)
        return labels, depth_mm, points

    def close(self) -> None:
        self._window.Finalize()

    def __enter__(self) -> MaskRenderer:
        return self

    def __exit__(self, *_error) -> None:
        self.close()

    def _draw(self, camera_from_world: np.ndarray) -> tuple[float, float]:
        depth = transform(np.asarray(camera_from_world, float), self._centre_mm)[2]
        # Tight planes keep the depth buffer's steps far below a micrometre.
        far = max(depth + self._radius_mm, 1.0)
        near = max(depth - self._radius_mm, far * 1e-3)
        apply_to_vtk_camera(self._renderer.GetActiveCamera(), self.camera, camera_from_world, near, far)
        self._window.Render()
        return near, far

    def _read_labels(self) -> np.ndarray:
        width, height = self.camera.width, self.camera.height
        self._window.GetPixelData(0, 0, width - 1, height - 1, 0, self._pixels, 0)
        grey = vtk_to_numpy(self._pixels).reshape(height, width, 3)[::-1, :, 0]
        labels = self._LABEL_OF_GREY[grey]
        if self._outside is not None:
            labels[self._outside] = BACKGROUND
        return labels
