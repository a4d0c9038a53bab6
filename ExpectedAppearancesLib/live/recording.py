"""What is kept of recorded frames, and their export as poses.json with the images beside it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import files
from ..errors import InputError
from ..geometry.camera import Camera
from ..geometry.pose import is_rigid
from ..registration.poses_file import check_vessels, read_poses, write_poses
from ..registration.tracking import TrackedPose, TrackState
from .steady import Steadied, View

if TYPE_CHECKING:
    from ..registration.predictor import Prediction

FORMAT = "ExpectedAppearances live frame"


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """One recorded frame; time_s: since the recording began. image_rgb may be left out (None) where only the note is
    needed. camera is that of the image, without distortion. prediction: the frame's own pose, accepted if an overlay
    was drawn; steadied: None where each frame stood for itself."""

    time_s: float
    name: str
    camera: Camera
    prediction: Prediction
    image_rgb: np.ndarray | None = None
    steadied: Steadied | None = None

    @property
    def camera_from_world(self) -> np.ndarray | None:
        """The pose that was drawn: the filtered one where poses were steadied."""
        return self.steadied.camera_from_world if self.steadied else self.prediction.camera_from_world


def to_note(frame: RecordedFrame, case_key: str) -> str:
    """JSON that is saved with the frame in the scene: everything but the pixels, poses in full precision."""
    prediction = frame.prediction
    pose = prediction.camera_from_world
    return json.dumps(
        _steadied_note(frame)
        | {
            "format": FORMAT,
            "case": case_key,
            "time_s": frame.time_s,
            "name": frame.name,
            "camera": frame.camera.to_dict(),
            "camera_from_world": None if pose is None else np.asarray(pose, float).tolist(),
            "accepted": bool(prediction.accepted),
            "confidence": _known(prediction.confidence),
            "latency_ms": float(prediction.latency_ms),
        }
    )


def from_note(text: str) -> tuple[RecordedFrame, str]:
    """The frame without its pixels, and the key of its case. Raises InputError for anything else."""
    from ..registration.predictor import Prediction

    try:
        values = json.loads(text)
        if values["format"] != FORMAT:
            raise ValueError("another format")
        pose = values["camera_from_world"]
        pose = None if pose is None else np.array(pose, float)
        if pose is not None and not is_rigid(pose):
            raise ValueError("its pose is not rigid")
        prediction = Prediction(
            pose,
            values["accepted"] is True and pose is not None,
            math.nan if values["confidence"] is None else float(values["confidence"]),
            float(values["latency_ms"]),
        )
        camera = Camera.from_dict(values["camera"], "recorded frame: camera")
        time_s, name, steadied = float(values["time_s"]), str(values["name"]), _steadied(values)
        if steadied is not None and prediction.accepted and steadied.camera_from_world is None:
            raise ValueError("accepted, without the pose that was drawn")
        return RecordedFrame(time_s, name, camera, prediction, steadied=steadied), str(values["case"])
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"recorded frame: its note cannot be read ({error}); record again.") from error


def export_recording(folder: Path, frames: Iterable[RecordedFrame], vessels_sha256: str | None = None) -> Path:
    """Write frames/NNNNN.png and poses.json into `folder`; returns the path of poses.json, written last.

    vessels_sha256: of the case that they were registered to.

    Raises InputError when there is no frame, when the camera changes (one poses.json has one camera), or on a full
    disk.
    """
    from ..registration.record import frame_record

    folder = Path(folder)
    entries, camera = [], None
    for number, frame in enumerate(frames):
        if camera is None:
            camera = frame.camera
        elif frame.camera != camera:
            raise InputError(
                f"recording: frame {number} ({frame.name}) has another size or camera than those before it; export "
                "the recordings from before and after the change one by one."
            )
        image = folder / "frames" / f"{number:05d}.png"
        files.write_png(image, frame.image_rgb)
        entry = frame_record(image, frame.prediction) | _steadied_note(frame)
        entry |= {"time_s": round(frame.time_s, 4), "source": frame.name}
        entries.append(entry | {"confidence": _known(frame.prediction.confidence)})
    if not entries:
        raise InputError("recording: there is no frame to export; record some first.")
    write_poses(folder / "poses.json", camera, entries, vessels_sha256)
    return folder / "poses.json"


def _steadied_note(frame: RecordedFrame) -> dict:
    """The filtered pose beside the frame's own, with the keys that `register --track` writes."""
    from ..registration.record import tracking_record

    if frame.steadied is None:
        return {}
    record = tracking_record(frame.steadied.tracked)
    record["tracking"]["view"] = frame.steadied.view.value
    return record


def _steadied(values: dict) -> Steadied | None:
    if "tracking" not in values:
        return None
    tracking, pose = values["tracking"], values["tracked_camera_from_world"]
    pose = None if pose is None else np.array(pose, float)
    if pose is not None and not is_rigid(pose):
        raise ValueError("its filtered pose is not rigid")
    covariance = None if tracking["covariance"] is None else np.array(tracking["covariance"], float)
    used = tracking["used"] is True and pose is not None
    return Steadied(View(tracking["view"]), TrackedPose(pose, covariance, TrackState(tracking["state"]), used))


def _known(confidence: float) -> float | None:
    """JSON has no NaN: a pose whose confidence nobody gave."""
    return float(confidence) if math.isfinite(confidence) else None


def add_truth(
    folder: Path, frame: RecordedFrame, camera_from_world: np.ndarray, vessels_sha256: str | None = None
) -> Path:
    """Add a frame with its true pose to folder/poses.json, as `evaluate` reads it; returns the path of the file. The
    frame that was added last gets the new pose. vessels_sha256: of the case that it was aligned to.

    Raises InputError when the file has another camera or case, holds poses that were registered, or is damaged.
    """
    path = Path(folder) / "poses.json"
    entries = []
    if path.is_file():
        camera, known = read_poses(path)
        # As dicts, since no distortion is read back as zeros.
        if camera is None or camera.to_dict() != frame.camera.to_dict():
            raise InputError(f"{path}: holds frames of another camera or size; choose another folder.")
        if vessels_sha256:
            check_vessels(path, vessels_sha256)
        if any("accepted" in f.extra for f in known):
            raise InputError(f"{path}: holds poses that were registered, not true ones; choose another folder.")
        entries = [f.to_dict() for f in known]
    if entries and _shows(known[-1].image, frame.image_rgb):
        entries[-1]["camera_from_world"] = camera_from_world
    else:
        number = len(entries)
        while (image := Path(folder) / "frames" / f"{number:05d}.png").exists():
            number += 1
        files.write_png(image, frame.image_rgb)
        entries.append({"image": image, "camera_from_world": camera_from_world})
    write_poses(path, frame.camera, entries, vessels_sha256)
    return path


def _shows(path: Path, image_rgb: np.ndarray) -> bool:
    """Whether the file is there and holds this image."""
    return path.is_file() and np.array_equal(files.read_image_rgb(path), image_rgb)
