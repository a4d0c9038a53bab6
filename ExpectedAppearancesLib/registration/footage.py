"""Frames and their time stamps, from a video or from ordered images."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import files
from ..errors import InputError, Problems

VIDEO_SUFFIXES = frozenset(
    (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".ogv", ".ts", ".webm", ".wmv")
)
FRAME_MARK = "#frame="  # parts a video's path from the number of one of its frames
LARGEST_RATE_HZ = 1000.0  # containers without a frame rate report 0, or their clock's ticks
_last_read: dict[tuple, tuple] = {}  # by video and its time of change: what plays it, and the frame that follows


@dataclass(frozen=True)
class FootageFrame:
    """image: its path, or the video's with #frame=N, N from 0; time_s: None where no frame rate is known; read_rgb:
    uint8 (H, W, 3), raises InputError."""

    image: Path
    time_s: float | None
    read_rgb: Callable[[], np.ndarray]


class Footage:
    """What `register` is given: one video, or images in the order of time. Raises InputError with every problem.

    rate_hz: frames per second; for a video in place of its own time stamps, for images the only source of time. count:
    number of frames; of a video as its file tells, 0 where it does not.
    """

    def __init__(self, paths: Sequence[Path], rate_hz: float | None = None):
        self._paths = [Path(path) for path in paths]
        self._rate_hz = rate_hz
        self._video = any(path.suffix.lower() in VIDEO_SUFFIXES for path in self._paths)
        problems = Problems()
        for path in self._paths:
            if not os.path.isfile(path):
                problems.add(f"{path}: {'video' if self._video else 'image'} not found; check the path.")
        if self._video and len(self._paths) > 1:
            problems.add(f"{self._paths[0]}: a video is registered on its own; give one video, or only images.")
        if rate_hz is not None and not 0 < rate_hz <= LARGEST_RATE_HZ:
            problems.add(f"--fps {rate_hz:g}: must be above 0 and at most {LARGEST_RATE_HZ:g} frames per second.")
        problems.raise_if_any()
        self.count = self._video_count() if self._video else len(self._paths)

    @property
    def is_video(self) -> bool:
        return self._video

    def __iter__(self) -> Iterator[FootageFrame]:
        return self._video_frames() if self._video else self._image_frames()

    def _image_frames(self) -> Iterator[FootageFrame]:
        for i, path in enumerate(self._paths):
            time_s = None if self._rate_hz is None else i / self._rate_hz
            yield FootageFrame(path, time_s, lambda path=path: files.read_image_rgb(path))

    def _video_count(self) -> int:
        import cv2

        capture = _open(self._paths[0])
        count, rate_hz = capture.get(cv2.CAP_PROP_FRAME_COUNT), capture.get(cv2.CAP_PROP_FPS)
        capture.release()
        if self._rate_hz is None and not 0 < rate_hz <= LARGEST_RATE_HZ:
            raise InputError(f"{self._paths[0]}: its frame rate cannot be read; give it with --fps.")
        return int(count) if math.isfinite(count) and count > 0 else 0

    def _video_frames(self) -> Iterator[FootageFrame]:
        import cv2

        path, capture = self._paths[0], _open(self._paths[0])
        interval_s = 1 / (self._rate_hz or capture.get(cv2.CAP_PROP_FPS))
        try:
            number, time_s = 0, -interval_s
            while True:
                found, image = capture.read()
                if not found:
                    break
                stamp_s = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000
                # Stamps follow a varying frame rate, but some containers have none, or repeat one.
                following = self._rate_hz is None and math.isfinite(stamp_s) and stamp_s > time_s
                time_s = stamp_s if following else time_s + interval_s
                rgb = np.ascontiguousarray(image[..., ::-1])
                yield FootageFrame(path.with_name(f"{path.name}{FRAME_MARK}{number}"), time_s, lambda rgb=rgb: rgb)
                number += 1
        finally:
            capture.release()
        if number == 0:
            raise InputError(f"{path}: no frame of this video can be read; save it again as MP4 (H.264) or AVI.")


def video_and_number(image: Path) -> tuple[Path, int] | None:
    """Of a frame that is called VIDEO#frame=N; None where it is a file of its own."""
    name, mark, number = image.name.rpartition(FRAME_MARK)
    return (image.with_name(name), int(number)) if mark and number.isdecimal() and not image.is_file() else None


def is_there(image: Path) -> bool:
    """Whether the file of a frame is there; for VIDEO#frame=N that of the video."""
    found = video_and_number(image)
    return (found[0] if found else image).is_file()


def read_frame_rgb(image: Path) -> np.ndarray:
    """A frame as poses files name them, uint8 RGB (H, W, 3): an image file, or VIDEO#frame=N. Raises InputError."""
    if FRAME_MARK in image.name and not os.path.isfile(image):
        return _read_video_frame(image)
    return files.read_image_rgb(image)


def _read_video_frame(path: Path) -> np.ndarray:
    named = video_and_number(path)
    if named is None or not named[0].is_file():
        raise InputError(f"{path}: video not found; check the path.")
    video, number = named
    version = (video, video.stat().st_mtime_ns)
    # Frames are counted from the first one: where they are not equally long OpenCV's search finds others.
    capture, following = _last_read.pop(version, (None, 0))
    if capture is None or number < following:
        _last_read.clear()
        capture, following = _open(video), 0
    found = all(capture.grab() for _ in range(number - following))
    found, image = capture.read() if found else (False, None)
    if not found:
        raise InputError(f"{path}: the video has no such frame; register it again.")
    _last_read[version] = capture, number + 1  # mostly the next one is asked for
    return np.ascontiguousarray(image[..., ::-1])


def _open(path: Path):
    import cv2

    files.require_text(path)
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        capture.release()
        raise InputError(f"{path}: not a video that OpenCV can read (or damaged); save it as MP4 (H.264) or AVI.")
    return capture
