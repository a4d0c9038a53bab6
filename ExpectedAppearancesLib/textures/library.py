"""Textures T: photographs of some cortex with the label map T_class of each, read and checked."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from .. import files
from ..errors import InputError, Problems
from ..masks.labels import BACKGROUND, CLASS_NAMES, PARENCHYMA, TISSUES, VESSELS

LABELS_SUFFIX = ".labels.png"
SHARED_LABELS = "labels.png"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
MINIMUM_CLASS_PX = 200  # below this a Gram matrix says more about the single pixels than about the tissue


@dataclass(frozen=True)
class Texture:
    """One T: `image` uint8 RGB (H, W, 3) and its `labels` uint8 (H, W): 0 background, 1 parenchyma, 2 vessels.

    Background is usually absent; synthesis defines it as black, the dark outside of the microscope's field.
    """

    name: str
    image: np.ndarray
    labels: np.ndarray

    @cached_property
    def sha256(self) -> str:
        """Of image and labels: what appearances made from the texture depend on."""
        return hashlib.sha256(self.image.tobytes() + self.labels.tobytes()).hexdigest()


def shipped_textures_folder() -> Path:
    """Folder of the textures that come with the library (made by textures/generate.py)."""
    return Path(__file__).parent / "generated"


def is_shipped(folder: Path) -> bool:
    """Whether these are the textures that ship, by whatever path they are named."""
    return Path(folder).resolve() == shipped_textures_folder().resolve()


def copy_textures(source: Path, folder: Path) -> None:
    """Make `folder`, to which photographs can be added, of the textures in another one; whole or not at all.

    Raises InputError where it cannot be written.
    """
    part = folder.with_name(f".{folder.name}.{os.getpid()}.part")
    try:
        with files.writing(folder):
            part.mkdir(parents=True)
            for path in filter(Path.is_file, source.iterdir()):
                shutil.copyfile(path, part / path.name)  # without its rights: an installed one may be read-only
            part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def read_library(folder: Path, exclude: Iterable[str] = ()) -> list[Texture]:
    """Every texture of `folder`, sorted by name, without the names in `exclude`.

    NAME.png (or .jpg, .tif) goes with NAME.labels.png, or with one labels.png for all. Raises InputError with all
    problems at once: no folder, no textures, unknown excluded names, unreadable files, and what check_texture finds.
    """
    folder = Path(folder)
    images = _checked_images(folder)
    exclude = {str(name) for name in exclude}
    problems = Problems()
    unknown = sorted(exclude - set(images))
    if unknown:
        problems.add(
            f"{folder}: no texture is called {', '.join(unknown)}, so it cannot be excluded; "
            f"there are {', '.join(images)}."
        )
    textures = []
    for name, paths in images.items():
        if name not in exclude:
            with problems.collect():
                textures.append(read_texture(name, *paths))
    problems.found = list(dict.fromkeys(problems.found))  # what is wrong with a label map of all is said once
    if not textures and not problems.found:
        problems.add(f"{folder}: every texture is excluded; leave at least one.")
    problems.raise_if_any()
    return textures


def list_textures(folder: Path) -> dict[str, tuple[Path, Path | None]]:
    """Image and label map of each texture by name, unread; None where a label map is missing. {} for no folder.

    For panels, which show what is there before all of it is right.
    """
    folder = Path(folder)
    images = _named_images(folder)[0] if os.path.isdir(folder) else {}
    labels = ((name, (folder / f"{name}{LABELS_SUFFIX}", folder / SHARED_LABELS)) for name in images)
    return {name: (images[name], next((path for path in paths if path.is_file()), None)) for name, paths in labels}


def problems_of_folder(folder: Path) -> list[str]:
    """Of one that cannot be read, or in which two images would be the same texture, such as a.png and a.jpg."""
    return _named_images(Path(folder))[1]


def read_texture(name: str, image_path: Path, labels_path: Path | None) -> Texture:
    """One texture. Raises InputError with all its problems."""
    if labels_path is None:
        raise InputError(
            f"{image_path}: has no label map; add {name}{LABELS_SUFFIX} (1 parenchyma, 2 vessels), or one "
            f"{SHARED_LABELS} for all textures, or remove it."
        )
    problems = Problems()
    image = labels = None
    with problems.collect():
        image = files.read_image_rgb(image_path)
    with problems.collect():
        labels = files.read_label_map(labels_path)
    if image is not None and labels is not None:
        problems.found.extend(check_texture(image_path, image, labels_path, labels))
    problems.raise_if_any()
    return Texture(name, image, labels)


def check_texture(path: Path, image: np.ndarray, labels_path: Path, labels: np.ndarray) -> list[str]:
    """Problems of one texture: sizes that differ, values other than 0, 1, 2, too few pixels of a class."""
    found = []
    if image.shape[:2] != labels.shape:
        found.append(
            f"{path}: is {image.shape[1]} x {image.shape[0]} px but its label map {labels_path.name} is "
            f"{labels.shape[1]} x {labels.shape[0]} px; make both the same size."
        )
    foreign = sorted(set(np.unique(labels).tolist()) - {BACKGROUND, PARENCHYMA, VESSELS})
    if foreign:
        shown = ", ".join(str(value) for value in foreign[:5])
        found.append(
            f"{labels_path}: holds the value(s) {shown}; "
            "only 0 (background), 1 (parenchyma) and 2 (vessels) are allowed."
        )
    for label in TISSUES:
        count = int((labels == label).sum())
        if count < MINIMUM_CLASS_PX:
            found.append(
                f"{labels_path}: only {count} px of {CLASS_NAMES[label]} (value {label}), at least {MINIMUM_CLASS_PX} "
                "are needed; label more of it, or leave this texture out."
            )
    return found


def _checked_images(folder: Path) -> dict[str, tuple[Path, Path | None]]:
    if not folder.is_dir():
        raise InputError(f"{folder}: textures folder not found; check the path.")
    images, problems = _named_images(folder)
    if problems:
        raise InputError(problems)
    if not images:
        raise InputError(f"{folder}: holds no textures; put NAME.png with NAME{LABELS_SUFFIX} there.")
    return list_textures(folder)


def _named_images(folder: Path) -> tuple[dict[str, Path], list[str]]:
    """Images by name, the last one where several have it, and which these are."""
    images: dict[str, Path] = {}
    problems = []
    try:
        paths = sorted(folder.iterdir())
    except OSError as error:  # a share that others may look into, or one of those that macOS guards
        return {}, [f"{folder}: cannot be read ({error.strerror or error}); choose a folder that you may look into."]
    for path in paths:
        is_labels = path.name.lower() == SHARED_LABELS or path.name.lower().endswith(LABELS_SUFFIX)
        if path.suffix.lower() not in IMAGE_SUFFIXES or is_labels or path.name.startswith("."):
            continue
        if path.stem in images:
            problems.append(
                f"{path}: another texture is called {path.stem} too ({images[path.stem].name}); rename one."
            )
        images[path.stem] = path
    return {name: images[name] for name in sorted(images, key=files.natural_order)}, problems
