"""The pinhole camera: intrinsics A with OpenCV distortion, in pixels, pixel centres at integers."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .. import files
from ..errors import InputError, Problems

DISTORTION_LENGTHS = (4, 5, 8, 12, 14)  # the models of cv2.projectPoints
ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class Camera:
    """Intrinsics A of a frame of `width` x `height` px.

    fx, fy, cx, cy in px, pixel centres at integers (the middle of a W px row is (W - 1) / 2).
    distortion: OpenCV's coefficients (k1, k2, p1, p2, k3, ...), possibly empty.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    @property
    def matrix(self) -> np.ndarray:
        """A, 3x3, px."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_distorted(self) -> bool:
        return any(self.distortion)

    def without_distortion(self) -> Camera:
        return replace(self, distortion=())

    def resized(self, width: int, height: int) -> Camera:
        """Camera of the same view resampled to width x height px (pixel edges, not centres, coincide)."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            width=int(width),
            height=int(height),
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def has_aspect_of(self, width: int, height: int) -> bool:
        """Whether a frame of width x height px has the aspect ratio of this camera's, so that A can be scaled to it."""
        return abs(width * self.height / (height * self.width) - 1) <= ASPECT_TOLERANCE

    def cropped(self, left: int, top: int, width: int, height: int) -> Camera:
        """Camera of the part of the frame that starts at pixel (left, top)."""
        return replace(self, width=int(width), height=int(height), cx=self.cx - left, cy=self.cy - top)

    def project(self, points_camera_mm: np.ndarray) -> np.ndarray:
        """(N, 3) camera mm -> (N, 2) px, distortion included."""
        import cv2

        points = np.asarray(points_camera_mm, float).reshape(-1, 1, 3)
        distortion = np.array(self.distortion) if self.distortion else None
        return cv2.projectPoints(points, np.zeros(3), np.zeros(3), self.matrix, distortion)[0].reshape(-1, 2)

    def field_of_view_mm(self, depth_mm: float) -> float:
        """Shorter side of the view at `depth_mm`, mm."""
        return depth_mm * min(self.width / self.fx, self.height / self.fy)

    def to_dict(self) -> dict:
        return {
            "width": self.width,
            "height": self.height,
            "fx": self.fx,
            "fy": self.fy,
            "cx": self.cx,
            "cy": self.cy,
            "distortion": list(self.distortion) or [0.0] * 5,
        }

    @staticmethod
    def from_dict(values: dict, source: str = "camera") -> Camera:
        """From the keys of camera.json. Raises InputError with every problem, naming `source`."""
        problems = Problems()
        if not isinstance(values, dict):
            raise InputError(f"{source}: holds no camera; it needs width, height, fx, fy, cx, cy and distortion.")
        numbers = {}
        for key in ("width", "height", "fx", "fy", "cx", "cy"):
            value = values.get(key)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                problems.add(f"{source}: '{key}' is missing or not a number; give it in pixels.")
            else:
                numbers[key] = value
        distortion = values.get("distortion") or []
        try:
            distortion = tuple(float(d) for d in distortion)
            if not all(map(math.isfinite, distortion)):
                raise ValueError
        except (TypeError, ValueError):
            problems.add(f"{source}: 'distortion' must be a list of numbers in OpenCV's order.")
            distortion = ()
        if distortion and len(distortion) not in DISTORTION_LENGTHS:
            problems.add(
                f"{source}: 'distortion' has {len(distortion)} numbers; OpenCV's models have {DISTORTION_LENGTHS}."
            )
        for key in ("width", "height", "fx", "fy"):
            if numbers.get(key, 1) <= 0:
                problems.add(f"{source}: '{key}' is {numbers[key]}; it must be above 0 px.")
        if not problems.found:
            for centre, size in (("cx", "width"), ("cy", "height")):
                if not -0.5 <= numbers[centre] <= numbers[size] - 0.5:
                    problems.add(
                        f"{source}: the principal point {centre} = {numbers[centre]} px lies outside the image "
                        f"({size} {numbers[size]} px); these intrinsics do not belong to this image size."
                    )
            for key, size in (("fx", "width"), ("fy", "height")):
                if not 0.2 <= numbers[key] / numbers[size] <= 100:
                    problems.add(
                        f"{source}: {key} = {numbers[key]} px does not fit an image {size} of {numbers[size]} px; "
                        "give focal lengths in px, not mm."
                    )
        problems.raise_if_any()
        width, height = int(numbers.pop("width")), int(numbers.pop("height"))
        return Camera(width, height, *(float(numbers[k]) for k in ("fx", "fy", "cx", "cy")), distortion)

    @staticmethod
    def from_field_of_view(width: int, height: int, field_of_view_mm: float, working_distance_mm: float) -> Camera:
        """Ideal camera that sees `field_of_view_mm` across the image width at `working_distance_mm`."""
        if min(width, height, field_of_view_mm, working_distance_mm) <= 0:
            raise InputError("camera: image size (px), field of view (mm) and working distance (mm) must be above 0.")
        focal_px = width * working_distance_mm / field_of_view_mm
        return Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)


def undistorted(image: np.ndarray, camera: Camera) -> np.ndarray:
    """The frame (H, W[, C]) of `camera` as an ideal camera with the same A sees it, for whom label maps are drawn."""
    import cv2

    return cv2.undistort(image, camera.matrix, np.array(camera.distortion)) if camera.is_distorted else image


def read_camera(path: Path) -> Camera:
    """Camera from camera.json or from the YAML/XML that OpenCV's calibration writes. Raises InputError."""
    path = Path(path)
    if path.suffix.lower() in (".yml", ".yaml", ".xml"):
        return _read_opencv_calibration(path)
    return Camera.from_dict(files.read_json(path, "camera"), str(path))


def write_camera(path: Path, camera: Camera) -> None:
    files.write_json(path, camera.to_dict())


def _read_opencv_calibration(path: Path) -> Camera:
    import cv2

    if not os.path.isfile(path):
        raise InputError(f"{path}: camera not found; check the path.")
    try:
        # From memory: FileStorage cannot open non-ASCII paths on Windows.
        storage = cv2.FileStorage(path.read_text(encoding="utf-8"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        matrix = storage.getNode("camera_matrix").mat()
        distortion = storage.getNode("distortion_coefficients").mat()
        width, height = (storage.getNode(key).real() for key in ("image_width", "image_height"))
        fisheye = storage.getNode("fisheye_model")
        is_fisheye = fisheye.isInt() and bool(fisheye.real())
    except (cv2.error, SystemError, UnicodeDecodeError, OSError) as error:
        raise InputError(
            f"{path}: not an OpenCV calibration file ({error}); save it with OpenCV's calibration."
        ) from error
    if matrix is None or matrix.shape != (3, 3):
        raise InputError(f"{path}: 'camera_matrix' (3x3) is missing; save it with OpenCV's calibration.")
    # Each would be taken for another lens, and every pose be wrong.
    problems = Problems()
    if is_fisheye:
        problems.add(f"{path}: is of a fisheye model, which is not known here; calibrate again without it.")
    if distortion is None:
        problems.add(f"{path}: 'distortion_coefficients' is missing; save it with OpenCV's calibration.")
    if abs(matrix[0, 1]) > 1e-6 * matrix[0, 0] or abs(matrix[2, 2] - 1) > 1e-6:
        problems.add(
            f"{path}: 'camera_matrix' has a skew ({matrix[0, 1]:g} px) or is scaled ({matrix[2, 2]:g} in its corner), "
            "which is not known here; calibrate again without skew."
        )
    problems.raise_if_any()
    values = {"width": int(width), "height": int(height), "fx": matrix[0, 0], "fy": matrix[1, 1]}
    values |= {"cx": matrix[0, 2], "cy": matrix[1, 2]}
    values = {key: float(value) for key, value in values.items()}
    values["distortion"] = distortion.ravel().tolist()
    return Camera.from_dict(values, str(path))
