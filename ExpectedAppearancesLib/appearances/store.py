"""Expected appearances in a case: PNG images, and an index that says from which pose each one is seen."""

from __future__ import annotations

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from .. import files
from ..case.case import Case
from ..errors import InputError
from ..geometry.camera import Camera
from . import METHODS

CONTACT_SHEET = "contact_sheet.png"  # lies beside them


@dataclass(frozen=True)
class Appearance:
    """image_path: RGB PNG; seen by `camera` from camera_from_world (4, 4); texture `style`, noise `seed`."""

    image_path: Path
    labels_path: Path
    style: str
    seed: int
    camera: Camera
    camera_from_world: np.ndarray
    gram_distance: float  # to the texture, both classes together (measure.GramMeasure)

    @cached_property
    def image(self) -> np.ndarray:
        """uint8 RGB (H, W, 3), read once."""
        return files.read_image_rgb(self.image_path)


def folder_of(case: Case, method: str) -> Path:
    return case.appearances_folder / method


def index_path(case: Case, method: str) -> Path:
    """Its SHA-256 tells one set of appearances from another."""
    return folder_of(case, method) / "index.json"


def write_index(case: Case, method: str, camera: Camera, settings: dict, items: list[dict], done: bool) -> None:
    content = {"method": method, "done": done, "camera": camera.to_dict(), "settings": settings, "items": items}
    files.write_json(index_path(case, method), content)


def read_index(case: Case, method: str) -> dict | None:
    """The index as written, or None where the method has not run."""
    path = index_path(case, method)
    return files.read_json(path, "index of the expected appearances") if path.is_file() else None


def newest_image(folder: Path) -> tuple[Path | None, int]:
    """The appearance in a folder that was finished last, and how many there are; images appear there whole.

    For those who watch while appearances are made; the index is written when all are.
    """
    try:
        with os.scandir(folder) as entries:
            images = [e for e in entries if e.name.endswith(".png") and not e.name.startswith(".")]
            images = [e for e in images if not e.name.endswith(".labels.png") and e.name != CONTACT_SHEET]
            newest = max(images, key=lambda entry: entry.stat().st_mtime_ns, default=None)
            return (Path(newest.path) if newest else None), len(images)
    except OSError:
        return None, 0


def read_appearances(case: Case, method: str | None = None) -> tuple[str, list[Appearance]]:
    """Method and its finished appearances; without a method the one that is complete, `surface` first.

    Raises InputError when none is complete or an image is missing.
    """
    candidates = [method] if method else list(METHODS)
    for name in candidates:
        index = read_index(case, name)
        if index and index["done"]:
            folder = folder_of(case, name)
            camera = Camera.from_dict(index["camera"], str(index_path(case, name)))
            found = [
                Appearance(
                    folder / item["image"],
                    (folder / item["labels"]).resolve(),
                    item["style"],
                    item["seed"],
                    camera,
                    np.array(item["camera_from_world"], float),
                    item["gram_distance"],
                )
                for item in index["items"]
            ]
            missing = [str(a.image_path) for a in found if not a.image_path.is_file()]
            if missing:
                raise InputError(f"{missing[0]}: expected appearance missing; run `synthesize` again.")
            return name, found
    started = [name for name in candidates if read_index(case, name)]
    state = "are not finished" if started else "have not been made"
    raise InputError(f"{case.folder}: its expected appearances {state}; run `synthesize` first.")
