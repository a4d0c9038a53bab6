"""What `register` writes down about a frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..geometry.pose import rotation_vector
from .predictor import Prediction
from .tracking import TrackedPose


def frame_record(image: Path, prediction: Prediction) -> dict:
    """One entry of poses.json; rotation vector (rad) and translation (mm) are those of camera_from_world.

    covariance: (6, 6) as of `Prediction`, None where there is none.
    """
    pose, covariance = prediction.camera_from_world, prediction.covariance
    return {
        "image": str(image),
        "camera_from_world": pose,
        "accepted": prediction.accepted,
        "confidence": round(prediction.confidence, 5),
        "rotation_vector_rad": None if pose is None else rotation_vector(pose[:3, :3]).tolist(),
        "translation_mm": None if pose is None else pose[:3, 3].tolist(),
        "covariance": None if covariance is None else np.asarray(covariance).tolist(),
        "latency_ms": round(prediction.latency_ms, 2),
    }


def tracking_record(tracked: TrackedPose) -> dict:
    """What tracking adds to a frame's entry; pose and covariance are None while the view is lost."""
    pose, covariance = tracked.camera_from_world, tracked.covariance
    return {
        "tracked_camera_from_world": None if pose is None else pose.tolist(),
        "tracking": {
            "state": tracked.state.value,
            "used": tracked.used,
            "covariance": None if covariance is None else covariance.tolist(),
        },
    }
