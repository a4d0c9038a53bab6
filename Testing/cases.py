"""Small meshes and cases for tests: a domed patch with an asymmetric Y of vessels on it; and how to wait."""

from __future__ import annotations

import itertools
import time

import numpy as np

from ExpectedAppearancesLib.case.meshes import Mesh, write_vtp
from ExpectedAppearancesLib.geometry.camera import Camera, write_camera
from ExpectedAppearancesLib.textures.library import Texture


def dome(side_mm: float = 40.0, cells: int = 24, bulge_mm: float = 4.0) -> Mesh:
    """Cortex patch around the z axis, highest (z = 0) in the middle; outward is +z."""
    line = np.linspace(-side_mm / 2, side_mm / 2, cells + 1)
    x, y = np.meshgrid(line, line)
    z = -bulge_mm * (x**2 + y**2) / (side_mm / 2) ** 2
    n = cells + 1
    corner = (np.arange(cells)[:, None] * n + np.arange(cells)).ravel()
    lower = np.stack([corner, corner + 1, corner + n + 1], axis=1)
    upper = np.stack([corner, corner + n + 1, corner + n], axis=1)
    return Mesh(np.stack([x, y, z], axis=-1).reshape(-1, 3), np.vstack([lower, upper]))


def vessels(bulge_mm: float = 4.0, side_mm: float = 40.0, radius_mm: float = 1.0) -> Mesh:
    """Tubes along an asymmetric Y that lie on `dome`."""
    paths = [[(-14, -12), (-3, 0), (4, 3), (13, 12)], [(4, 3), (9, -4), (14, -13)], [(-3, 0), (-8, 9)]]
    vertices, triangles = [], []
    for path in paths:
        points = np.concatenate([np.linspace(a, b, 9)[:-1] for a, b in itertools.pairwise(path)] + [[path[-1]]])
        heights = -bulge_mm * (points**2).sum(axis=1) / (side_mm / 2) ** 2 + 0.3 * radius_mm
        spine = np.column_stack([points, heights])
        ahead = np.gradient(spine, axis=0)
        across = np.cross(ahead, [0, 0, 1.0])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        up = np.cross(across, ahead)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        angle = np.linspace(0, 2 * np.pi, 8, endpoint=False)
        rings = spine[:, None] + radius_mm * (
            np.cos(angle)[None, :, None] * across[:, None] + np.sin(angle)[None, :, None] * up[:, None]
        )
        base = sum(len(v) for v in vertices)
        for i in range(len(spine) - 1):
            for k in range(8):
                a, b = base + 8 * i + k, base + 8 * i + (k + 1) % 8
                triangles += [(a, b, b + 8), (a, b + 8, a + 8)]
        vertices.append(rings.reshape(-1, 3))
    return Mesh(np.vstack(vertices), np.array(triangles))


def camera(size: int = 96) -> Camera:
    """Off-centre principal point, fx != fy."""
    return Camera(size, size, 1.9 * size, 1.85 * size, size * 0.52, size * 0.47)


def write_inputs(folder) -> dict:
    """vessels.vtp, cortex.vtp and camera.json in `folder`, by name."""
    paths = {name: folder / name for name in ("vessels.vtp", "cortex.vtp", "camera.json")}
    write_vtp(paths["vessels.vtp"], vessels())
    write_vtp(paths["cortex.vtp"], dome())
    write_camera(paths["camera.json"], camera())
    return paths


def label_map(size: int = 48) -> np.ndarray:
    """Background, parenchyma and vessels, without symmetry."""
    labels = np.zeros((size, size), np.uint8)
    labels[4:-4, 2:-6] = 1
    labels[size // 3 : size // 2, : size // 2] = 2
    return labels


def texture(name: str = "a", vessel_colour=(40, 30, 160), size: int = 48) -> Texture:
    """Two colours with noise, one for each class."""
    rng = np.random.default_rng(5)
    labels = np.ones((size, size), np.uint8)
    labels[size // 2 :, size // 3 : size // 2] = 2
    image = np.where((labels == 2)[..., None], vessel_colour, (210, 130, 110)) + rng.normal(0, 15, (size, size, 3))
    return Texture(name, np.clip(image, 0, 255).astype(np.uint8), labels)


def wait_until(condition, timeout_s: float = 120.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)
