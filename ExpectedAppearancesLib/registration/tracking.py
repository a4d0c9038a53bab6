"""Poses of a video, filtered: constant-velocity error-state Kalman filter on SE(3). Numpy and scipy only.

After J. Sola, Quaternion kinematics for the error-state Kalman filter (2017), and T. Barfoot, State Estimation for
Robotics (2017).

The state is the pose and its twist per second, about the case's centre: a microscope that orbits its focus then keeps
its twist, and rotation and translation of the error are all but independent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from ..geometry import se3
from ..geometry.pose import inverse, pose_from_rotation

if TYPE_CHECKING:
    from .predictor import Prediction


class TrackState(str, Enum):
    """TRACKING: this frame was used. COASTING: carried on without it. LOST: no pose."""

    TRACKING = "tracking"
    COASTING = "coasting"
    LOST = "lost"


@dataclass(frozen=True)
class TrackerSettings:
    """How a microscope moves, and when its view counts as lost.

    centre_world_mm (3,): the point that Prediction.covariance is about, `Predictor.encoding.centre_world_mm`.
    velocity_change_mm_s, turn_change_deg_s: process noise as the standard deviation, per axis, of how much velocity
    changes within one second of white acceleration. velocity_mm_s, turn_deg_s: standard deviation of what it may be
    where a track begins. gate_share: share of right poses that the gate lets through (chi-square, 6 degrees of
    freedom). lost_after_s: without a frame that was used. lost_sigma_mm, lost_sigma_deg: standard deviation, in the
    worst direction, from which the pose says nothing. agreeing_frames: accepted frames, within lost_after_s, that must
    lie on one motion before a track begins. lasting_share: share of a frame's covariance that no averaging over time
    takes away, since a network errs in much the same way in the next frame.
    """

    centre_world_mm: np.ndarray
    velocity_change_mm_s: float = 20.0
    turn_change_deg_s: float = 10.0
    velocity_mm_s: float = 30.0
    turn_deg_s: float = 15.0
    gate_share: float = 0.999
    lost_after_s: float = 1.0
    lost_sigma_mm: float = 10.0
    lost_sigma_deg: float = 12.0
    agreeing_frames: int = 3
    lasting_share: float = 0.6


@dataclass(frozen=True)
class TrackedPose:
    """camera_from_world (4, 4) and covariance (6, 6), as of `Prediction`, or None when lost; used: whether the frame's
    own pose had a part in it."""

    camera_from_world: np.ndarray | None
    covariance: np.ndarray | None
    state: TrackState
    used: bool


class Tracker:
    """One video's track. `update` with every frame in the order of time, also with those that were refused."""

    def __init__(self, settings: TrackerSettings):
        from scipy.special import gammaincinv

        self.settings = settings
        self._gate = float(2 * gammaincinv(3, settings.gate_share))  # chi-square of 6 degrees of freedom
        self._camera_from_centred = pose_from_rotation(np.eye(3), np.asarray(settings.centre_world_mm, float))
        self.reset()

    def reset(self) -> None:
        """Forget everything, as before the first frame."""
        self._time_s: float | None = None
        self._used_s = -math.inf
        self._filter: _Filter | None = None
        self._unused: list[_Measured] = []

    def update(self, time_s: float, prediction: Prediction | None) -> TrackedPose:
        """The pose at time_s, a frame's time stamp, with what was predicted for that frame; None: no frame, or refused.

        A prediction without covariance is not used. Frames no newer than the last are left out; a stamp that is older
        than lost_after_s means that the clock, or the video, began again. Raises ValueError for a time that is not
        finite.
        """
        if not math.isfinite(time_s):
            raise ValueError(f"time stamp {time_s} is not finite")
        if self._time_s is not None and time_s <= self._time_s:
            if self._time_s - time_s <= self.settings.lost_after_s:
                return self._answer(False)
            self.reset()
        self._time_s = time_s
        if self._filter is not None:
            self._filter.advance(time_s)
            if time_s - self._used_s > self.settings.lost_after_s or self._filter.is_vague():
                self._filter = None
        measured = self._measure(time_s, prediction)
        used = measured is not None and self._use(measured)
        if used:
            self._used_s = time_s
            self._unused = []
        return self._answer(used)

    def _measure(self, time_s: float, prediction: Prediction | None) -> _Measured | None:
        if prediction is None or not prediction.accepted or prediction.covariance is None:
            return None
        pose = prediction.camera_from_world @ self._camera_from_centred
        covariance = _turned(prediction.covariance, pose[:3, :3].T)
        if not (np.isfinite(pose).all() and np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0):
            return None
        return _Measured(time_s, pose, covariance)

    def _use(self, measured: _Measured) -> bool:
        if self._filter is not None and self._filter.distance(measured) <= self._gate:
            self._filter.correct(measured)
            return True
        since_s = measured.time_s - self.settings.lost_after_s
        # Three times what is needed: a third of them may be wrong, and beginning stays cheap.
        recent = [m for m in self._unused if m.time_s >= since_s][1 - 3 * self.settings.agreeing_frames :]
        self._unused = [*recent, measured]
        if self._filter is None:
            self._filter = self._begun()
            return self._filter is not None
        return False

    def _begun(self) -> _Filter | None:
        """A track on which the newest frame and enough of the unused ones before it lie, the one with the most."""
        best, most = None, self.settings.agreeing_frames - 1
        for first in range(len(self._unused) - most):
            track, agreeing, agrees = _Filter(self._unused[first], self.settings), 1, True
            for measured in self._unused[first + 1 :]:
                track.advance(measured.time_s)
                agrees = not track.is_vague() and track.distance(measured) <= self._gate
                if agrees:
                    track.correct(measured)
                    agreeing += 1
            if agrees and agreeing > most:
                best, most = track, agreeing
        return best

    def _answer(self, used: bool) -> TrackedPose:
        if self._filter is None:
            return TrackedPose(None, None, TrackState.LOST, False)
        pose = self._filter.pose @ inverse(self._camera_from_centred)
        lasting = self.settings.lasting_share * self._filter.newest
        covariance = _turned(self._filter.covariance[:6, :6] + lasting, self._filter.pose[:3, :3])
        return TrackedPose(pose, covariance, TrackState.TRACKING if used else TrackState.COASTING, used)


@dataclass(frozen=True)
class _Measured:
    """A frame's pose as camera from the centred world; covariance (6, 6) of its error on the world's side."""

    time_s: float
    pose: np.ndarray
    covariance: np.ndarray


class _Filter:
    """pose: camera from the centred world; twist (6,) per second; covariance (12, 12) of the errors (e, d) with
    true pose = pose exp(e), true twist = twist + d. newest (6, 6): covariance of the frame used last."""

    def __init__(self, first: _Measured, settings: TrackerSettings):
        self._settings = settings
        self._noise = _axes(settings.turn_change_deg_s, settings.velocity_change_mm_s) ** 2
        self._time_s = first.time_s
        self.pose, self.twist, self.newest = first.pose, np.zeros(6), first.covariance
        self.covariance = np.zeros((12, 12))
        self.covariance[:6, :6] = first.covariance
        self.covariance[6:, 6:] = np.diag(_axes(settings.turn_deg_s, settings.velocity_mm_s) ** 2)

    def advance(self, time_s: float) -> None:
        seconds = time_s - self._time_s
        self._time_s = time_s
        step = se3.exp(self.twist * seconds)
        transition = np.eye(12)
        transition[:6, :6] = se3.adjoint(inverse(step))
        transition[:6, 6:] = se3.right_jacobian(self.twist * seconds) * seconds
        # White acceleration, integrated once into the twist and twice into the pose.
        growth = np.array([[seconds**3 / 3, seconds**2 / 2], [seconds**2 / 2, seconds]])
        self.pose = self.pose @ step
        self.covariance = transition @ self.covariance @ transition.T + np.kron(growth, np.diag(self._noise))

    def distance(self, measured: _Measured) -> float:
        """Squared Mahalanobis distance of a measured pose."""
        difference = se3.log(inverse(self.pose) @ measured.pose)
        spread = self.covariance[:6, :6] + measured.covariance
        return float(difference @ np.linalg.solve(spread, difference))

    def correct(self, measured: _Measured) -> None:
        difference = se3.log(inverse(self.pose) @ measured.pose)
        spread = self.covariance[:6, :6] + measured.covariance
        gain = np.linalg.solve(spread, self.covariance[:6]).T
        change = gain @ difference
        self.pose = self.pose @ se3.exp(change[:6])
        self.twist = self.twist + change[6:]
        # Joseph's form: stays positive definite under rounding.
        kept = np.eye(12)
        kept[:, :6] -= gain
        covariance = kept @ self.covariance @ kept.T + gain @ measured.covariance @ gain.T
        self.covariance = (covariance + covariance.T) / 2
        self.newest = measured.covariance

    def is_vague(self) -> bool:
        worst = [np.linalg.eigvalsh(self.covariance[part, part])[-1] for part in (slice(0, 3), slice(3, 6))]
        limits = (math.radians(self._settings.lost_sigma_deg), self._settings.lost_sigma_mm)
        return any(not variance <= limit**2 for variance, limit in zip(worst, limits))


def _axes(degrees: float, millimetres: float) -> np.ndarray:
    """(6,), rad and mm, the same for each axis."""
    return np.repeat([math.radians(degrees), millimetres], 3)


def _turned(covariance: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Covariance (6, 6) of a rotation and a translation, both expressed in other axes."""
    both = np.kron(np.eye(2), rotation)
    return both @ covariance @ both.T
