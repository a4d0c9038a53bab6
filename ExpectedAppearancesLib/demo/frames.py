"""Test frames of the generated patient, painted by VTK without any of the code that synthesises appearances.

A model tested on them meets colours, patterns and lighting that neither its textures nor its augmentation made.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import vtk
from scipy.spatial import cKDTree
from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

from .. import files
from ..case.meshes import Mesh
from ..geometry.camera import Camera
from ..geometry.pose import apply_to_vtk_camera, transform
from ..masks.renderer import offscreen_window
from ..registration.poses_file import write_poses

OVERSAMPLING = 2
FINE_TRIANGLES = 120_000  # colours live on vertices: about two to a pixel of the demo's frames
WAVES = 48

# RGB 0..1: parenchyma, its blood-rich mottling, fine arteries, vessels, their second colour.
PALETTES = (
    ((0.86, 0.63, 0.53), (0.75, 0.36, 0.30), (0.66, 0.12, 0.11), (0.42, 0.28, 0.40), (0.55, 0.16, 0.20)),
    ((0.80, 0.55, 0.42), (0.88, 0.72, 0.56), (0.72, 0.22, 0.13), (0.34, 0.33, 0.46), (0.44, 0.20, 0.28)),
    ((0.78, 0.46, 0.43), (0.60, 0.24, 0.24), (0.52, 0.05, 0.08), (0.36, 0.10, 0.17), (0.50, 0.36, 0.46)),
    ((0.84, 0.72, 0.64), (0.72, 0.50, 0.46), (0.75, 0.26, 0.22), (0.58, 0.14, 0.15), (0.32, 0.24, 0.38)),
)


@dataclass(frozen=True, eq=False)
class UnseenStyle:
    """How one set of frames looks. Colours RGB 0..1; light_offset: of the lamp, in units of the distance (x, y)."""

    parenchyma: np.ndarray
    mottling: np.ndarray
    arteries: np.ndarray
    vessels: np.ndarray
    vessels_second: np.ndarray
    light: np.ndarray
    light_offset: np.ndarray
    specular: float
    seed: int


def unseen_style(index: int, seed: int) -> UnseenStyle:
    """Style `index`: one of the palettes, shifted by chance, under its own light."""
    rng = np.random.default_rng([seed, index, 11])
    colours = np.array(PALETTES[index % len(PALETTES)]) + rng.normal(0, 0.02, (5, 3))
    light = np.clip(np.array([1.0, 0.97, 0.93]) * rng.uniform(0.95, 1.05, 3), 0, 1)
    return UnseenStyle(
        *np.clip(colours, 0.02, 0.98),
        light,
        rng.uniform(-0.35, 0.35, 2),
        rng.uniform(0.25, 0.5),
        int(rng.integers(2**31)),
    )


def write_unseen_frames(
    folder: Path, vessels: Mesh, cortex: Mesh, camera: Camera, poses: np.ndarray, styles: int, seed: int
) -> Path:
    """Paint a frame from each of `poses` (N, 4, 4), split over `styles` styles; returns the path of poses.json.

    Frames are folder/unseen-K/NNN.jpg, undistorted, black outside the surface.
    """
    folder = Path(folder)
    camera = camera.without_distortion()
    fine = _refined(cortex)
    entries = []
    for k, indices in enumerate(np.array_split(np.arange(len(poses)), styles)):
        name = f"unseen-{k + 1}"
        style = unseen_style(k, seed)
        painter = _Painter(vessels, fine, camera, style)
        try:
            for i in indices:
                image = folder / name / f"{i:03d}.jpg"
                files.write_bytes(image, _jpeg(painter.paint(poses[i], int(i))))
                entries.append({"image": image, "camera_from_world": poses[i], "style": name})
        finally:
            painter.close()
    path = folder / "poses.json"
    write_poses(path, camera, entries)
    return path


class _Painter:
    def __init__(self, vessels: Mesh, fine_cortex: Mesh, camera: Camera, style: UnseenStyle):
        self._camera = camera
        self._large = camera.resized(camera.width * OVERSAMPLING, camera.height * OVERSAMPLING)
        self._style = style
        everything = np.vstack([vessels.vertices_mm, fine_cortex.vertices_mm])
        self._centre_mm = (everything.min(axis=0) + everything.max(axis=0)) / 2
        self._radius_mm = float(np.linalg.norm(everything - self._centre_mm, axis=1).max()) * 1.01
        self._window = offscreen_window(self._large.width, self._large.height)
        self._renderer = vtk.vtkRenderer()
        self._renderer.SetBackground(0, 0, 0)
        self._renderer.SetAutomaticLightCreation(False)
        self._lamp = vtk.vtkLight()
        self._lamp.SetLightTypeToSceneLight()
        self._lamp.SetColor(*style.light)
        self._renderer.AddLight(self._lamp)
        self._window.AddRenderer(self._renderer)
        self._add(fine_cortex, _cortex_colours(fine_cortex, vessels, style), 0.6 * style.specular, 25)
        self._add(vessels, _vessel_colours(vessels, style), 1.4 * style.specular, 45)
        self._pixels = vtk.vtkUnsignedCharArray()

    def paint(self, camera_from_world: np.ndarray, number: int) -> np.ndarray:
        """uint8 RGB (H, W, 3) from the pose; `number` seeds the sensor's noise."""
        import cv2

        rotation = camera_from_world[:3, :3]
        centre = -rotation.T @ camera_from_world[:3, 3]
        depth_mm = transform(camera_from_world, self._centre_mm)[2]
        self._lamp.SetPosition(*(centre + depth_mm * (rotation[:2].T @ self._style.light_offset)))
        self._lamp.SetFocalPoint(*self._centre_mm)
        near, far = max(depth_mm - self._radius_mm, 1.0), depth_mm + self._radius_mm
        apply_to_vtk_camera(self._renderer.GetActiveCamera(), self._large, camera_from_world, near, far)
        self._window.Render()
        width, height = self._large.width, self._large.height
        self._window.GetPixelData(0, 0, width - 1, height - 1, 0, self._pixels, 0)
        large = vtk_to_numpy(self._pixels).reshape(height, width, 3)[::-1]
        image = cv2.resize(large, (self._camera.width, self._camera.height), interpolation=cv2.INTER_AREA)
        lit = image.any(axis=2, keepdims=True)
        noise = np.random.default_rng([self._style.seed, number]).normal(0, 2.0, image.shape)
        return np.clip(image + noise * lit, 0, 255).round().astype(np.uint8)

    def close(self) -> None:
        self._window.Finalize()

    def _add(self, mesh: Mesh, colours: np.ndarray, specular: float, shininess: float) -> None:
        polydata = mesh.to_polydata()
        polydata.GetPointData().SetScalars(numpy_to_vtk((np.clip(colours, 0, 1) * 255).astype(np.uint8), deep=True))
        mapper = vtk.vtkPolyDataMapper()
        mapper.SetInputData(polydata)
        actor = vtk.vtkActor()
        actor.SetMapper(mapper)
        surface = actor.GetProperty()
        surface.SetInterpolationToPhong()
        surface.SetDiffuse(1.0)
        surface.SetAmbient(0.12)
        surface.SetSpecular(specular)
        surface.SetSpecularPower(shininess)
        self._renderer.AddActor(actor)


def _cortex_colours(cortex: Mesh, vessels: Mesh, style: UnseenStyle) -> np.ndarray:
    """RGB (N, 3) of the vertices: mottled parenchyma, fine arteries, and a shadow along the large vessels."""
    points = cortex.vertices_mm
    rng = np.random.default_rng(style.seed)
    blotches = 0.5 + 0.3 * _solid_noise(points, 7.0, rng) + 0.15 * _solid_noise(points, 2.0, rng)
    colours = _mixed(style.parenchyma, style.mottling, blotches)
    colours *= 1 + 0.05 * _solid_noise(points, 1.1, rng)[:, None] + 0.03 * _solid_noise(points, 0.5, rng)[:, None]
    for scale_mm, width in ((6.0, 0.055), (3.5, 0.05)):
        # Where a smooth noise crosses 0 runs a winding line; a second noise breaks it into pieces.
        line = np.exp(-((_solid_noise(points, scale_mm, rng) / width) ** 2))
        pieces = np.clip(0.3 + _solid_noise(points, 5.0, rng), 0, 1)
        colours = _mixed(colours, style.arteries, 0.75 * line * pieces)
    distance_mm = cKDTree(vessels.vertices_mm).query(points)[0]
    return colours * (1 - 0.4 * np.exp(-((distance_mm / 0.45) ** 2)))[:, None]


def _vessel_colours(vessels: Mesh, style: UnseenStyle) -> np.ndarray:
    rng = np.random.default_rng([style.seed, 1])
    blend = 0.4 + 0.35 * _solid_noise(vessels.vertices_mm, 9.0, rng)
    shade = 1 + 0.08 * _solid_noise(vessels.vertices_mm, 1.5, rng)
    return _mixed(style.vessels, style.vessels_second, blend) * shade[:, None]


def _solid_noise(points_mm: np.ndarray, scale_mm: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth noise in space, mean 0, variance about 1, with features of about `scale_mm`; (N,)."""
    waves = rng.normal(0, 2 / scale_mm, (WAVES, 3))
    phases = rng.uniform(0, 2 * np.pi, WAVES)
    angle = (points_mm @ waves.T + phases).astype(np.float32)
    return np.cos(angle).sum(axis=1) * np.sqrt(2 / WAVES)


def _mixed(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    share = np.clip(share, 0, 1)[:, None]
    return (1 - share) * first + share * second


def _refined(mesh: Mesh) -> Mesh:
    """The same surface in enough triangles to carry fine colours."""
    polydata = mesh.to_polydata()
    divisions = max(0, int(np.ceil(np.log(FINE_TRIANGLES / len(mesh.triangles)) / np.log(4))))
    if not divisions:
        return mesh
    divider = vtk.vtkLinearSubdivisionFilter()
    divider.SetNumberOfSubdivisions(divisions)
    divider.SetInputData(polydata)
    divider.Update()
    return Mesh.from_polydata(divider.GetOutput())


def _jpeg(image_rgb: np.ndarray) -> bytes:
    import cv2

    ok, data = cv2.imencode(".jpg", image_rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 93])
    if not ok:
        raise ValueError(f"image of shape {image_rgb.shape} cannot be encoded")
    return data.tobytes()
