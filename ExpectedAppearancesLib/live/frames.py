"""Frames as they arrive, and what is done to one before it is registered, so that A stays true."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..errors import InputError
from ..geometry.camera import Camera

if TYPE_CHECKING:  # at run time it would load OpenCV, which the panel offers to install
    from ..registration.predictor import Prediction

SMALLEST_PX = 32
BLACK = 24  # of 255; borders of recorded video are not quite 0
LIT_SHARE = 0.01  # of a row or column: single hot pixels are no picture
LEAST_PICTURE = 0.25  # of the frame's width and height; less is a dark scene, not a border
BLANK_RANGE = 6  # of 255 between the darkest and brightest sample: a picture has more, a test signal less


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """One frame of a source: uint8 RGB (H, W, 3) as it came, when it came (s, monotonic clock; -inf for one that was
    there before anybody looked), its number and name.

    given: the pose that comes with the frame, where it was registered before; such a frame is not predicted again.
    """

    image_rgb: np.ndarray
    taken_s: float
    number: int
    name: str = ""
    given: Prediction | None = None


@dataclass(frozen=True)
class FrameSettings:
    """flip_rows: the source counts its rows from the bottom. crop_borders: cut black borders off; the camera may have
    been calibrated with or without them. longest_px: frames are scaled down to this longest side before they are
    shown and recorded.
    """

    flip_rows: bool = False
    crop_borders: bool = False
    longest_px: int = 960


class FramePreparation:
    """Turns frames into pictures of an ideal camera: flipped, cropped, scaled, undistorted, each with its own A."""

    def __init__(self, camera: Camera, settings: FrameSettings | None = None):
        self._camera = camera
        self._settings = settings or FrameSettings()
        self._box: tuple[int, int, int, int] | None = None
        self._frame_size: tuple[int, int] | None = None
        self._maps: dict[Camera, tuple[np.ndarray, np.ndarray]] = {}

    def prepare(self, image: np.ndarray) -> tuple[np.ndarray, Camera]:
        """uint8 RGB (H, W, 3) without distortion, and the camera that took it. Raises InputError for no picture."""
        import cv2

        image = checked_rgb(image)
        if self._settings.flip_rows:
            image = image[::-1]
        camera, box = self._camera_and_box(image)
        left, top, width, height = box
        if (width, height) != (image.shape[1], image.shape[0]):
            image = image[top : top + height, left : left + width]
        shrink = self._settings.longest_px / max(width, height)
        if shrink < 1:
            size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
            # Averaging over fractions of pixels costs ten times as much, and above one half it gains nothing.
            average = shrink <= 0.5
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA if average else cv2.INTER_LINEAR)
            camera = camera.resized(*size)
        if camera.is_distorted:
            image = cv2.remap(image, *self._undistortion(camera), cv2.INTER_LINEAR)
            camera = camera.without_distortion()
        return np.ascontiguousarray(image), camera

    def _camera_and_box(self, image: np.ndarray) -> tuple[Camera, tuple[int, int, int, int]]:
        """The camera of the part of the frame that is kept, and that part: left, top, width, height in px."""
        height, width = image.shape[:2]
        if self._frame_size != (width, height):
            self._frame_size, self._box = (width, height), None
        with_borders = self._camera.has_aspect_of(width, height)  # as A was calibrated
        box = (0, 0, width, height) if with_borders else None
        if self._settings.crop_borders:
            box = self._picture_box(image, with_borders)
        if box is not None and with_borders:
            return self._camera.resized(width, height).cropped(*box), box
        if box is not None:
            return self._camera.resized(box[2], box[3]), box
        found = picture_box(image)
        raise InputError(
            f"the frame is {width} x {height} px ({found[2]} x {found[3]} px without black borders), the camera "
            f"{self._camera.width} x {self._camera.height} px: another aspect ratio; cut black borders off, give the "
            "source the size that the camera was calibrated with, or calibrate again."
        )

    def _picture_box(self, image: np.ndarray, with_borders: bool) -> tuple[int, int, int, int] | None:
        """The frame without black borders; None where the camera was calibrated on a picture of another shape."""

        def fits(box: tuple) -> bool:
            return with_borders or self._camera.has_aspect_of(box[2], box[3])

        found = picture_box(image)
        known = self._box or found
        # Only ever grown: a dark moment must not cut a part of the picture away.
        grown = _union(known, found)
        # But a menu or a flash on the border must not add to it for ever.
        box = next((box for box in (grown, found) if fits(box)), None)
        self._box = box or (known if fits(known) else grown)
        return box

    def _undistortion(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        import cv2

        if camera not in self._maps:
            size = (camera.width, camera.height)
            maps = cv2.initUndistortRectifyMap(
                camera.matrix, np.array(camera.distortion), None, camera.matrix, size, cv2.CV_16SC2
            )
            self._maps = {camera: maps}
        return self._maps[camera]


def checked_rgb(image: np.ndarray) -> np.ndarray:
    """The frame as uint8 RGB; grey becomes RGB, alpha is left out. Raises InputError when it is no picture."""
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim not in (2, 3):
        what = f"{getattr(image, 'dtype', type(image).__name__)} of shape {getattr(image, 'shape', '?')}"
        raise InputError(f"the source sends {what}; it must send 8-bit grey or RGB pictures.")
    if image.ndim == 2:
        image = image[..., None]
    if image.shape[2] not in (1, 3, 4):
        raise InputError(f"the source sends {image.shape[2]} values per pixel; it must send grey or RGB.")
    if min(image.shape[:2]) < SMALLEST_PX:
        raise InputError(
            f"the frame is {image.shape[1]} x {image.shape[0]} px; at least {SMALLEST_PX} px are needed each way."
        )
    if image.shape[2] == 1:
        image = np.repeat(image, 3, axis=2)
    image = image[..., :3]
    sample = image[::8, ::8]
    if int(sample.max()) - int(sample.min()) < BLANK_RANGE:
        raise InputError("the frame is blank, all of one colour; check the camera, its cable and the light.")
    return image


def picture_box(image: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, width, height (px) of the frame without black borders; the whole frame when little would remain."""
    height, width = image.shape[:2]
    bright = image[..., 1] > BLACK  # green alone: light enough in any picture, a third of the work
    rows = np.nonzero(np.count_nonzero(bright, axis=1) > LIT_SHARE * width)[0]
    columns = np.nonzero(np.count_nonzero(bright, axis=0) > LIT_SHARE * height)[0]
    if not len(rows) or not len(columns):
        return 0, 0, width, height
    left, top = int(columns[0]), int(rows[0])
    box = (left, top, int(columns[-1]) + 1 - left, int(rows[-1]) + 1 - top)
    if box[2] < LEAST_PICTURE * width or box[3] < LEAST_PICTURE * height:
        return 0, 0, width, height
    return box


def _union(first: tuple, second: tuple) -> tuple[int, int, int, int]:
    left, top = min(first[0], second[0]), min(first[1], second[1])
    right = max(first[0] + first[2], second[0] + second[2])
    bottom = max(first[1] + first[3], second[1] + second[3])
    return left, top, right - left, bottom - top
