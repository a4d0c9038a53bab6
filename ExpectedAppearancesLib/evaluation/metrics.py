"""The figures of merit, as defined once for the whole project (paper, section 3).

ADD: mean over the mesh vertices of ||(R x + t) - (R^ x + t^)||, mm.
n mm-n deg: share of frames with a translation error below n mm AND a geodesic rotation error below n degrees.
Translation error: distance between the two positions of the mesh centroid in the camera frame. Measuring it there, not
at the world origin, makes it independent of where the origin of the scan happens to lie.

Frames without a pose have no ADD and no errors (NaN): they are left out of means and quantiles, and count as a miss in
every share and in the AUC. A refused frame that has a pose is in the figures of all frames, and not in `accepted_only`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry.displacement import add_mm, mean_displacements_mm
from ..geometry.pose import geodesic_angle_rad, mean_rotation, pose_from_rotation
from ..registration.confidence import BINS, GOOD_ADD_MM, bin_of, calibration_error

ADD_RANGE_MM = 20.0
ACCURACY_LIMITS = (3, 5)  # n of the reported n mm-n deg


@dataclass(frozen=True, eq=False)
class FrameErrors:
    """One value for each of N frames; NaN where the frame has no pose. All in the camera frame.

    lateral_mm, depth_mm: mean length of the vertices' displacement across and along the optical axis.
    """

    add_mm: np.ndarray
    lateral_mm: np.ndarray
    depth_mm: np.ndarray
    rotation_deg: np.ndarray
    translation_mm: np.ndarray
    accepted: np.ndarray

    def __len__(self) -> int:
        return len(self.add_mm)

    def select(self, chosen: np.ndarray) -> FrameErrors:
        """The frames of a boolean mask (N,)."""
        return FrameErrors(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))


def frame_errors(
    vertices_mm: np.ndarray,
    true: Sequence[np.ndarray],
    predicted: Sequence[np.ndarray | None],
    accepted: Sequence[bool] | None = None,
) -> FrameErrors:
    """Errors of N predicted camera_from_world, None where there is no pose, against the true ones.

    accepted: without it, every frame with a pose is. Raises ValueError when the lengths differ.
    """
    if len(true) != len(predicted) or (accepted is not None and len(accepted) != len(true)):
        raise ValueError(f"{len(true)} true poses, {len(predicted)} predicted: not the same frames")
    vertices_mm = np.asarray(vertices_mm, float)
    has_pose = np.array([pose is not None for pose in predicted], bool)
    true_poses = np.array(true, float).reshape(-1, 4, 4)[has_pose]
    predicted_poses = np.array([pose for pose in predicted if pose is not None], float).reshape(-1, 4, 4)
    add, lateral, depth = mean_displacements_mm(vertices_mm, true_poses, predicted_poses)
    difference = true_poses - predicted_poses
    moved_centroid = difference[:, :3, :3] @ vertices_mm.mean(axis=0) + difference[:, :3, 3]
    rotation_deg = np.degrees(geodesic_angle_rad(true_poses[:, :3, :3], predicted_poses[:, :3, :3]))
    values = []
    for known in (add, lateral, depth, rotation_deg, np.linalg.norm(moved_centroid, axis=1)):
        values.append(np.full(len(has_pose), np.nan))
        values[-1][has_pose] = known
    return FrameErrors(*values, has_pose & (True if accepted is None else np.array(accepted, bool)))


def accuracy(errors: FrameErrors, limit: float) -> float | None:
    """Share of frames within `limit` mm and `limit` degrees, 0..1; None of no frames."""
    return _share((errors.translation_mm < limit) & (errors.rotation_deg < limit))


def add_accuracy(errors: FrameErrors, limit_mm: float) -> float | None:
    """Share of frames with ADD below `limit_mm`, 0..1; None of no frames."""
    return _share(errors.add_mm < limit_mm)


def add_auc(errors: FrameErrors) -> float | None:
    """Area under the curve of `add_accuracy` from 0 to ADD_RANGE_MM, divided by the range; exact, not sampled."""
    if not len(errors):
        return None
    below = np.clip(1 - errors.add_mm / ADD_RANGE_MM, 0, None)
    return float(np.where(np.isnan(below), 0.0, below).mean())


def summary(errors: FrameErrors) -> dict:
    """The figures of metrics.json for these frames; None where no frame has a pose."""
    return {
        "frames": len(errors),
        "refused": int((~errors.accepted).sum()),
        "without_pose": int(np.isnan(errors.add_mm).sum()),
        "add_mm": {
            "mean": _mean(errors.add_mm),
            "median": _quantile(errors.add_mm, 50),
            "p95": _quantile(errors.add_mm, 95),
            "lateral_mean": _mean(errors.lateral_mm),
            "depth_mean": _mean(errors.depth_mm),
        },
        "accuracy": {f"{n}mm-{n}deg": accuracy(errors, n) for n in ACCURACY_LIMITS},
        "add_below_3mm": add_accuracy(errors, GOOD_ADD_MM),
        "add_auc_20mm": add_auc(errors),
        "rotation_deg": _mean(errors.rotation_deg),
        "rotation_deg_median": _quantile(errors.rotation_deg, 50),
        "translation_mm": _mean(errors.translation_mm),
        "translation_mm_median": _quantile(errors.translation_mm, 50),
    }


def metrics(errors: FrameErrors, styles: Sequence[str | None]) -> dict:
    """metrics.json: the summary of all frames, of accepted frames only, and both again for each style."""
    labels = np.array(["no style" if style is None else style for style in styles], object)
    result = summary(errors) | {"accepted_only": summary(errors.select(errors.accepted)), "styles": {}}
    for label in sorted(set(labels)):
        of_style = errors.select(labels == label)
        accepted_only = summary(of_style.select(of_style.accepted))
        result["styles"][label] = summary(of_style) | {"accepted_only": accepted_only}
    return result


def reliability(confidence: np.ndarray, errors: FrameErrors) -> dict:
    """What the confidences (N,) 0..1 were worth: in each of BINS equal ranges the number of frames, their mean
    confidence and the share with ADD below GOOD_ADD_MM; and the mean gap between both, weighted by the numbers."""
    confidence, good = np.asarray(confidence, float), errors.add_mm < GOOD_ADD_MM
    which = bin_of(confidence)
    rows = []
    for b in range(BINS):
        own = which == b
        if own.any():
            rows.append(
                {
                    "from": b / BINS,
                    "to": (b + 1) / BINS,
                    "frames": int(own.sum()),
                    "confidence": float(confidence[own].mean()),
                    "add_below_3mm": float(good[own].mean()),
                }
            )
    return {"expected_calibration_error": calibration_error(confidence, good), "bins": rows}


def mean_pose(vertices_mm: np.ndarray, poses: Sequence[np.ndarray]) -> np.ndarray:
    """The pose (4, 4) that always answers the mean: chordal mean rotation, mean position of the mesh centroid.

    A baseline: a method that sees nothing in the image can do as well.
    """
    poses, centroid = np.asarray(poses, float), np.asarray(vertices_mm, float).mean(axis=0)
    rotation = mean_rotation(poses[:, :3, :3])
    position = (poses[:, :3, :3] @ centroid + poses[:, :3, 3]).mean(axis=0)
    return pose_from_rotation(rotation, position - rotation @ centroid)


def nearest_other_pose_add_mm(vertices_mm: np.ndarray, poses: Sequence[np.ndarray]) -> np.ndarray:
    """ADD (P,) of answering, for each distinct pose, the nearest other one, chosen knowing the truth: what memory of
    poses alone could reach. Empty for fewer than two distinct poses."""
    distinct = np.unique(np.round(np.asarray(poses, float).reshape(-1, 16), 6), axis=0).reshape(-1, 4, 4)
    some = vertices_mm[:: max(1, len(vertices_mm) // 300)]
    nearest = []
    for i, pose in enumerate(distinct if len(distinct) > 1 else ()):
        others = np.delete(distinct, i, axis=0)
        nearest.append(add_mm(some, np.broadcast_to(pose, others.shape), others).min())
    return np.array(nearest)


def _share(hits: np.ndarray) -> float | None:
    return float(hits.mean()) if len(hits) else None


def _mean(values: np.ndarray) -> float | None:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None


def _quantile(values: np.ndarray, percent: float) -> float | None:
    known = values[~np.isnan(values)]
    return float(np.percentile(known, percent)) if len(known) else None
