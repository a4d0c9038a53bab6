"""What `register` writes down about a frame."""

from __future__ import annotations

from pathlib import Path

from ..geometry.pose import rotation_vector
from .predictor import Prediction


def frame_record(image: Path, prediction: Prediction) -> dict:
    """One entry of poses.json; rotation vector (rad) and translation (mm) are those of camera_from_world."""
    pose = prediction.camera_from_world
    return {
        "image": str(image),
        "camera_from_world": pose,
        "accepted": prediction.accepted,
        "confidence": round(prediction.confidence, 5),
        "rotation_vector_rad": None if pose is None else rotation_vector(pose[:3, :3]).tolist(),
        "translation_mm": None if pose is None else pose[:3, 3].tolist(),
        "latency_ms": round(prediction.latency_ms, 2),
    }
