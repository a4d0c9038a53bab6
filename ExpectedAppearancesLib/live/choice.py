"""What the user chose to watch, what is missing in it, and the source that it means."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from enum import Enum
from pathlib import Path

from ..case.case import MANIFEST_NAME
from ..errors import InputError, Problems
from ..geometry.camera import Camera, read_camera
from ..registration.footage import VIDEO_SUFFIXES
from .estimator import given_poses, poses_of_video
from .frames import FrameSettings
from .sources import IMAGE_SUFFIXES, USUAL_RATE_HZ, CaptureDevice, ImageFiles, Source, VideoFile


class SourceKind(Enum):
    PATH = "path"  # an image, a folder of images, a video, or a poses.json
    DEVICE = "device"  # a capture device or a network stream
    NODE = "node"  # a volume in the scene


@dataclass(frozen=True)
class Choice:
    """path, device (a number, or a stream's address) or node_name: as the kind says. camera_path: '' for the case's.

    repeat, only_new: of files. rate_hz: of images without a speed of their own. stale_s: age at which trust ends.
    steady: poses are filtered over time.
    """

    case_path: str = ""
    kind: SourceKind = SourceKind.PATH
    path: str = ""
    device: str = "0"
    node_name: str = ""
    camera_path: str = ""
    repeat: bool = False
    only_new: bool = False
    rate_hz: float = USUAL_RATE_HZ
    stale_s: float = 0.5
    steady: bool = False
    frames: FrameSettings = field(default_factory=FrameSettings)

    @property
    def needs_model(self) -> bool:
        """False for frames whose poses come from a file."""
        return not (self.kind is SourceKind.PATH and self.path.lower().endswith(".json"))

    @property
    def frame_settings(self) -> FrameSettings:
        """`frames`, but that a frame whose pose comes from a file stays as it was registered."""
        return self.frames if self.needs_model else replace(self.frames, flip_rows=False)


@dataclass(frozen=True)
class OpenedSource:
    """source: None for a volume of the scene, which the scene's owner feeds. camera: None for the case's.

    still: a single picture, to be held once it is shown.
    """

    source: Source | None
    camera: Camera | None
    still: bool = False


def problems_of(choice: Choice) -> list[str]:
    """Everything that keeps the choice from being started, cheap enough to ask at each keystroke."""
    found = []  # os.path and not pathlib, whose answer on a network drive that is gone is an error
    if not choice.case_path:
        found.append("Choose the folder of a case.")
    elif not os.path.isfile(Path(choice.case_path) / MANIFEST_NAME):
        found.append(f"{choice.case_path} is not a case folder: it holds no {MANIFEST_NAME}.")
    elif choice.needs_model and not os.path.isfile(Path(choice.case_path) / "model" / "model.onnx"):
        found.append(
            f"The case {Path(choice.case_path).name} has no trained model yet; train it in the planning module."
        )
    if choice.kind is SourceKind.PATH:
        found += _problems_of_path(choice.path)
    elif choice.kind is SourceKind.DEVICE and not choice.device.strip():
        found.append("Give the number of the capture device (the first is 0), or the address of a stream.")
    elif choice.kind is SourceKind.NODE and not choice.node_name:
        found.append("Choose the volume that holds the microscope's picture.")
    if choice.camera_path and not os.path.isfile(choice.camera_path):
        found.append(f"{choice.camera_path}: camera file not found; choose it again, or none for the case's.")
    return found


def open_source(choice: Choice, case_camera: Camera | None = None) -> OpenedSource:
    """The source that was chosen. case_camera: of the frames, unless the choice names another; poses.json names that
    of its poses, and with no other one are they drawn right.

    Raises InputError with every problem.
    """
    problems = Problems()
    opened = camera = None
    with problems.collect():
        camera = read_camera(choice.camera_path) if choice.camera_path else None
    with problems.collect():
        opened = _opened(choice, camera or case_camera)
    problems.raise_if_any()
    return OpenedSource(opened.source, opened.camera or camera, opened.still)


def _opened(choice: Choice, camera: Camera | None) -> OpenedSource:
    if choice.kind is SourceKind.NODE:
        return OpenedSource(None, None)
    if choice.kind is SourceKind.DEVICE:
        device = choice.device.strip()
        size_px = (camera.width, camera.height) if camera else None
        return OpenedSource(CaptureDevice(int(device) if device.isdigit() else device, size_px), None)
    path = Path(choice.path)
    suffix = path.suffix.lower()
    if path.is_dir():
        return OpenedSource(ImageFiles(path, choice.rate_hz, choice.repeat, choice.only_new), None)
    if suffix == ".json":
        named, images, given = given_poses(path)
        video = poses_of_video(given)
        if video is not None:
            return OpenedSource(VideoFile(video[0], choice.repeat, given=video[1]), named)
        return OpenedSource(ImageFiles(images, choice.rate_hz, choice.repeat, given=given), named, len(images) == 1)
    if suffix in VIDEO_SUFFIXES:
        return OpenedSource(VideoFile(path, choice.repeat), None)
    if suffix in IMAGE_SUFFIXES:
        return OpenedSource(ImageFiles([path], choice.rate_hz), None, still=True)
    raise InputError(_unknown(path))


def _problems_of_path(text: str) -> list[str]:
    if not text:
        return ["Choose a folder of images, an image, a video, or a poses.json."]
    path = Path(text)
    if not os.path.exists(path):
        return [f"{text}: not found; check the path, or wait for its drive to return."]
    if os.path.isfile(path) and path.suffix.lower() not in (*IMAGE_SUFFIXES, *VIDEO_SUFFIXES, ".json"):
        return [_unknown(path)]
    return []


def _unknown(path: Path) -> str:
    return f"{path}: not a kind of file that can be watched; give an image, a video, a folder, or a poses.json."
