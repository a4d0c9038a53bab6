"""Poses of a session over time: what is drawn is the filtered pose, and only where the frame's own agrees with it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..registration.tracking import TrackedPose, Tracker, TrackerSettings, TrackState

if TYPE_CHECKING:
    from ..registration.predictor import Prediction

FOUND_S = 2.0  # how long it is said that the view was found again


class View(Enum):
    """What the frames together say of the view that they show."""

    FOLLOWING = "following"
    DOUBTED = "doubted"  # this frame was not used, and the view is not given up yet
    LOST = "lost"
    FOUND = "found again"  # following, since a moment ago


@dataclass(frozen=True)
class Steadied:
    """view, and what the tracker made of this frame, covariance and all."""

    view: View
    tracked: TrackedPose

    @property
    def camera_from_world(self) -> np.ndarray | None:
        """The pose to draw over this frame; None where the tracker did not use it: a guess is not shown."""
        return self.tracked.camera_from_world if self.tracked.used else None


class Steadying:
    """Filters one session's poses in the order of their frames."""

    def __init__(self, centre_world_mm: np.ndarray):
        """centre_world_mm (3,): the point that the covariances are about, `Predictor.encoding.centre_world_mm`."""
        self._tracker = Tracker(TrackerSettings(centre_world_mm))
        self._followed = False
        self._found_s = -math.inf

    def update(self, taken_s: float, prediction: Prediction | None) -> Steadied:
        """A frame's, also one without a pose; taken_s: when it was taken (s, monotonic)."""
        tracked = self._tracker.update(taken_s, prediction)
        if tracked.state is TrackState.LOST:
            if self._followed:
                self._found_s = math.inf
            return Steadied(View.LOST, tracked)
        if not tracked.used:
            return Steadied(View.DOUBTED, tracked)
        if self._found_s == math.inf:
            self._found_s = taken_s
        self._followed = True
        return Steadied(View.FOUND if taken_s - self._found_s < FOUND_S else View.FOLLOWING, tracked)


def can_steady(estimator) -> bool:
    """False without a model, and for one that tells no covariance, which the filter lives on."""
    return estimator is not None and getattr(estimator, "gives_covariance", False)


def check_can_steady(estimator, model_folder) -> None:
    """Raises InputError for a model whose poses cannot be steadied."""
    if estimator is not None and not can_steady(estimator):
        raise InputError(
            f"{model_folder}: this model does not tell how sure each pose is, which 'Steady' needs; switch it off, or "
            "train the case again."
        )
