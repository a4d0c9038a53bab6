"""poses.json: frames and their poses, in and out.

{"camera": {...} or the path of a camera file, "frames": [{"image", "camera_from_world", "style", ...}]}; OpenCV axes,
mm, world = the mesh files' coordinates. Paths are relative to the poses file that names them. "vessels_sha256", where
it is there, names the case that the poses were registered to.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .. import files
from ..errors import InputError, Problems
from ..geometry.camera import Camera, read_camera
from ..geometry.pose import is_rigid

_OWN_KEYS = ("image", "camera_from_world", "style")


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame: absolute path of its image, and its pose (4, 4), mm; None when it was refused without a pose.

    extra: every other key of the frame, for example accepted and confidence.
    """

    image: Path
    camera_from_world: np.ndarray | None
    style: str | None = None
    extra: dict = field(default_factory=dict)

    @property
    def accepted(self) -> bool:
        """False for a frame that registration refused; a frame that says nothing is accepted if it has a pose."""
        return bool(self.extra.get("accepted", True)) and self.camera_from_world is not None

    def to_dict(self) -> dict:
        """The frame as `write_poses` takes it."""
        own = {"image": self.image, "camera_from_world": self.camera_from_world}
        return own | ({"style": self.style} if self.style is not None else {}) | self.extra


def read_poses(path: Path) -> tuple[Camera | None, list[Frame]]:
    """Camera (None where the file names none) and frames. Raises InputError with every problem of the file."""
    path = Path(path).absolute()
    values = files.read_json(path, "poses file")
    if not isinstance(values, dict) or not isinstance(values.get("frames"), list):
        raise InputError(f"{path}: holds no frames; a poses file is {{'camera': ..., 'frames': [...]}}.")
    problems = Problems()
    camera = None
    with problems.collect():
        camera = _camera(path, values.get("camera"))
    if not values["frames"]:
        problems.add(f"{path}: its list of frames is empty; add at least one frame.")
    frames = []
    for index, entry in enumerate(values["frames"]):
        with problems.collect():
            frames.append(_frame(path, index, entry))
    _check_images_differ(path, frames, problems)
    problems.raise_if_any()
    return camera, frames


def check_vessels(path: Path, vessels_sha256: str) -> None:
    """Raise InputError where the poses file names the vessels of another case than those with this digest."""
    values = files.read_json(Path(path), "poses file")
    named = values.get("vessels_sha256") if isinstance(values, dict) else None
    if named not in (None, vessels_sha256):
        raise InputError(
            f"{path}: its poses are of another case, whose vessels they were registered to; choose that case, or "
            "register the frames to this one."
        )


def write_poses(
    path: Path, camera: Camera | None, frames: Iterable[Mapping], vessels_sha256: str | None = None
) -> None:
    """Write frames, each a dict with image (path), camera_from_world (4x4 or None) and any JSON values.

    Images are written relative to the file, with forward slashes; on another drive, absolute. vessels_sha256: of the
    case that the frames were registered to. Raises InputError.
    """
    path = Path(path).absolute()
    entries = []
    for frame in frames:
        pose = frame["camera_from_world"]
        pose = None if pose is None else np.asarray(pose, float).tolist()
        entries.append(dict(frame) | {"image": _relative(frame["image"], path.parent), "camera_from_world": pose})
    value = {"camera": camera.to_dict()} if camera else {}
    value |= {"vessels_sha256": vessels_sha256} if vessels_sha256 else {}
    convention = "camera_from_world maps world mm to camera mm; camera axes x right, y down, z forward (OpenCV)"
    files.write_json(path, value | {"convention": convention, "frames": entries})


def check_place(path: Path) -> None:
    """Raise InputError where `write_poses` could not write the file; makes nothing."""
    path = Path(path).absolute()
    if path.is_dir():
        raise InputError(f"{path}: is a folder; give the name of a file in it, as poses.json.")
    if path.exists() and path.suffix.lower() != ".json":  # the first of `--out frames/*.png` would be lost
        raise InputError(f"{path}: is there and no poses file, and would be replaced; give a name such as poses.json.")
    files.require_writable(path.parent)


def _camera(path: Path, value) -> Camera | None:
    if value is None:
        return None
    if isinstance(value, str):
        return read_camera(path.parent / value)
    return Camera.from_dict(value, f"{path}: camera")


def _frame(path: Path, index: int, entry) -> Frame:
    if not isinstance(entry, dict) or not isinstance(entry.get("image"), str) or not entry["image"]:
        raise InputError(f"{path}: frame {index} names no image; give it as 'image', relative to this file.")
    where = f"{path}: frame {index} ({entry['image']})"
    pose = entry.get("camera_from_world")
    if pose is not None:
        pose = _pose(where, pose)
    if entry.get("accepted") not in (None, True, False):  # "false" would be true to Python, and a refused pose shown
        raise InputError(f"{where}: 'accepted' is {entry['accepted']!r}; it must be true or false, without quotes.")
    style = entry.get("style")
    extra = {key: value for key, value in entry.items() if key not in _OWN_KEYS}
    image = Path(os.path.normpath(path.parent / entry["image"]))
    return Frame(image, pose, None if style is None else str(style), extra)


def _pose(where: str, value) -> np.ndarray:
    try:
        pose = np.array(value, float)
    except (TypeError, ValueError):
        pose = np.zeros(0)
    if pose.shape != (4, 4):
        raise InputError(f"{where}: camera_from_world is not a 4x4 matrix of numbers; give four rows of four.")
    if not is_rigid(pose):
        raise InputError(
            f"{where}: camera_from_world is not a rigid pose (rotation and translation in mm, last row 0 0 0 1); "
            "remove scaling, mirroring and values that are not finite."
        )
    return pose


def _check_images_differ(path: Path, frames: list[Frame], problems: Problems) -> None:
    seen = set()
    for frame in frames:
        if frame.image in seen:
            problems.add(f"{path}: {frame.image} is named by more than one frame; keep one of them.")
        seen.add(frame.image)


def _relative(image: str | Path, folder: Path) -> str:
    image = Path(image)
    if not image.is_absolute():
        image = Path.cwd() / image
    try:
        return Path(os.path.relpath(image, folder)).as_posix()
    except ValueError:  # another drive, on Windows
        return image.as_posix()
