"""Label maps that the planning panel asks a process of its own for: its own thread would wait for the drawing."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..case.meshes import Mesh
from ..geometry.camera import Camera
from ..poses.craniotomy import parenchyma_around
from .renderer import MaskRenderer


def write_meshes(folder: Path, vessels: Mesh, cortex: Mesh | None) -> None:
    """Put into `folder` what `question` refers to."""
    for name, mesh in (("vessels", vessels), ("cortex", cortex)):
        if mesh is not None:
            np.save(folder / f"{name}.vertices.npy", mesh.vertices_mm)
            np.save(folder / f"{name}.triangles.npy", mesh.triangles)


def question(folder: Path, camera: Camera, outward_axis: np.ndarray, camera_from_world: np.ndarray) -> dict:
    """What is asked: the label map of the meshes in `folder` from one pose. Without a cortex there is a disc below the
    vessels, across `outward_axis`."""
    return {
        "folder": str(folder),
        "camera": camera.to_dict(),
        "outward_axis": np.asarray(outward_axis, float).tolist(),
        "camera_from_world": np.asarray(camera_from_world, float).tolist(),
    }


def label_map(answer: str) -> np.ndarray:
    """uint8 (H, W), as `answering` has answered."""
    return np.load(answer, allow_pickle=False)


def answering() -> Callable[[dict], str]:
    """The function that answers: path of the label map. The renderer of the last question is kept."""
    kept: list = [None, None]
    turns = itertools.cycle((0, 1))  # what is answered is read while the next one is being drawn

    def answer(asked: dict) -> str:
        key = {name: asked[name] for name in ("folder", "camera", "outward_axis")}
        folder = Path(asked["folder"])
        if kept[0] != key:
            if kept[1] is not None:
                kept[1].close()
            cortex = _mesh(folder, "cortex") if (folder / "cortex.vertices.npy").is_file() else None
            vessels = _mesh(folder, "vessels")
            parenchyma = parenchyma_around(vessels, cortex, np.array(asked["outward_axis"]))
            kept[:] = key, MaskRenderer(vessels, parenchyma, Camera.from_dict(asked["camera"]))
        path = folder / f"labels.{next(turns)}.npy"
        np.save(path, kept[1].render(np.array(asked["camera_from_world"])))
        return str(path)

    return answer


def _mesh(folder: Path, name: str) -> Mesh:
    return Mesh(*(np.load(folder / f"{name}.{part}.npy", allow_pickle=False) for part in ("vertices", "triangles")))
