"""The model that a session asks for poses: opened for one case, and refused for another."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ..case.case import Case
from ..errors import InputError
from ..geometry.camera import Camera
from ..registration.footage import is_there, video_and_number
from ..registration.poses_file import read_poses

if TYPE_CHECKING:
    from ..registration.predictor import Prediction

PROVIDER_NAMES = {"CUDAExecutionProvider": "GPU (CUDA)", "CPUExecutionProvider": "CPU"}
THREADS = 2


class Estimator(Protocol):
    """What a session needs of a model; registration.predictor.Predictor is one."""

    def predict(self, image_rgb: np.ndarray, camera: Camera | None = None) -> Prediction: ...


@dataclass(frozen=True)
class OpenedModel:
    """estimator, and the device it runs on in words: 'GPU (CUDA)' or 'CPU'."""

    estimator: Estimator
    device: str


def open_model(case: Case) -> OpenedModel:
    """The case's model, warmed up. Raises InputError when it is missing, damaged, or was trained on other vessels."""
    try:
        import onnxruntime  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"onnxruntime, which runs the model, cannot be loaded ({error}); install it: the panel offers to, or give "
            "slicer.util.pip_install('onnxruntime') in the Python console."
        ) from error
    from ..registration.predictor import open_predictor

    estimator = open_predictor(case, THREADS)
    camera = estimator.case_camera
    # The first pass allocates and compiles: better now than with the first frame.
    estimator.predict(np.zeros((camera.height, camera.width, 3), np.uint8))
    return OpenedModel(estimator, PROVIDER_NAMES.get(estimator.provider, estimator.provider))


def given_poses(poses_path: Path) -> tuple[Camera | None, list[Path], dict[Path, Prediction]]:
    """Frames that were registered before, from poses.json: camera, paths (VIDEO#frame=N of a video), and the prediction
    of each path.

    Raises InputError with every problem of the file.
    """
    from ..registration.predictor import Prediction

    camera, frames = read_poses(poses_path)
    given = {
        frame.image: Prediction(
            frame.camera_from_world,
            frame.accepted,
            _number(frame.extra.get("confidence"), math.nan),
            _number(frame.extra.get("latency_ms"), 0.0),
        )
        for frame in frames
    }
    there = {frame.image for frame in frames if is_there(frame.image)}
    missing = [frame.image for frame in frames if frame.image not in there]
    if len(missing) == len(frames):
        raise InputError(
            f"{poses_path}: none of its images exists, {missing[0]} for one; restore them beside the file."
        )
    return camera, [frame.image for frame in frames if frame.image in there], given


def poses_of_video(given: dict[Path, Prediction]) -> tuple[Path, dict[int, Prediction]] | None:
    """The video whose frames all paths name, and the prediction of each number; None where they name anything else."""
    named = {image: video_and_number(image) for image in given}
    videos = {found and found[0] for found in named.values()}
    if len(videos) != 1 or None in videos:
        return None
    return videos.pop(), {named[image][1]: prediction for image, prediction in given.items()}


def _number(value, otherwise: float) -> float:
    return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else otherwise
