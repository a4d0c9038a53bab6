"""Where frames come from outside the scene: image files, a folder that is being filled, a video, a capture device.

A source is read by one thread (feed.py): `read` gives the next frame, or None when there is none yet, and raises
SourceLost when it has to be opened again. Sources pace themselves, so that a video plays at its own speed.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from .. import files
from ..errors import ExpectedAppearancesError, InputError
from .frames import LiveFrame

if TYPE_CHECKING:
    from ..registration.predictor import Prediction

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
DAMAGED_AFTER_S = 2.0  # a file that has not grown for so long and is still not whole never will be
USUAL_RATE_HZ = 25.0
REST = 4  # times as long as a look into a folder took, until the next one: of many thousands it takes long


class SourceLost(ExpectedAppearancesError):
    """The source gives no more frames for now; it may when it is opened again."""


class SourceEnded(ExpectedAppearancesError):
    """The source has given its last frame."""


class Source(Protocol):
    """What a feed reads. dropped: frames that the source itself left out to keep pace. can_wait: whether the next frame
    is still there after a pause; `go_on` ends one."""

    dropped: int
    can_wait: bool

    def open(self) -> None: ...

    def read(self) -> LiveFrame | None: ...

    def go_on(self) -> None: ...

    def close(self) -> None: ...


class ImageFiles:
    """The images of a list or folder, in the order of the numbers in their names, `rate_hz` of them a second.

    A folder is watched: images that come later follow, as soon as they are whole; of many that came meanwhile, as
    during a pause, only the last two, so that what is shown is the present. only_new leaves out those that were there
    at the start. given: pose of each image (by path) that was registered before.
    """

    def __init__(
        self,
        images: Path | Iterable[Path],
        rate_hz: float = USUAL_RATE_HZ,
        repeat: bool = False,
        only_new: bool = False,
        given: dict[Path, Prediction] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._folder = Path(images).absolute() if isinstance(images, (str, Path)) else None
        self._listed = [] if self._folder else [Path(p) for p in images]
        self._interval_s = 1 / max(rate_hz, 0.01)
        self._repeat, self._only_new, self._given, self._clock = repeat, only_new, given or {}, clock
        self.dropped = 0
        self.can_wait = True
        self._number = 0
        self._seen: set[str] | None = None
        self._next: list[Path] = []  # found and not shown yet, the last one first
        self._were_there = self._next_were_there = True  # those of the next look: then all are shown
        self._unfinished: dict[Path, tuple[tuple, float]] = {}

    def open(self) -> None:
        if self._folder and not os.path.isdir(self._folder):  # unlike pathlib's, False on a network drive that is gone
            raise SourceLost(f"{self._folder}: folder not found; check the path, or wait for its drive to return.")
        if not self._folder and not self._listed:
            raise InputError("no images are listed; give at least one.")
        self._due_s = self._clock()
        if self._seen is None:
            self._seen = set()
            self._left_out = set(map(str, self._unseen())) if self._folder and self._only_new else set()
            self._seen |= self._left_out

    def read(self) -> LiveFrame | None:
        if self._clock() < self._due_s:
            return None
        begin_s = self._clock()
        if not self._next:
            self._next = self._found()
        if self._next:
            path = self._next.pop()
            data = self._whole_file(path)
            if data is not None:
                self._seen.add(str(path))
                self._due_s = max(self._due_s + self._interval_s, self._clock())
                self._number += 1
                image = _decoded(data, path)
                return LiveFrame(image, self._clock(), self._number - 1, path.name, self._given.get(path))
            if os.path.exists(path):
                self._next.append(path)  # in order: those after it wait
            else:
                self._next, self._were_there = [], self._next_were_there
        elif self._repeat:
            self._seen, self._were_there = set(self._left_out), True
        elif not self._folder:
            raise SourceEnded("the last image was shown.")
        self._due_s = self._clock() + REST * (self._clock() - begin_s)
        return None

    def go_on(self) -> None:
        self._due_s = self._clock()
        self._forget_found()

    def close(self) -> None:
        self._unfinished = {}
        self._forget_found()

    def _forget_found(self) -> None:
        """What came before a pause is not the present after it."""
        if not self._next_were_there:
            self._next = []

    def _found(self) -> list[Path]:
        found, self._next_were_there = self._unseen(), self._were_there
        late = [] if self._were_there else found[:-2]  # the last may still be written
        self._seen.update(map(str, late))
        self.dropped += len(late)
        self._were_there = not self._folder
        return found[len(late) :][::-1]

    def _unseen(self) -> list[Path]:
        """Images that were not shown yet, in order. Of the others a folder may hold many thousands."""
        if not self._folder:
            return [path for path in self._listed if str(path) not in self._seen]
        try:
            with os.scandir(self._folder) as entries:
                new = [Path(entry.path) for entry in entries if entry.path not in self._seen]
        except OSError as error:
            raise SourceLost(
                f"{self._folder}: folder cannot be read ({error.strerror}); check the drive or the network."
            ) from error
        images = (p for p in new if p.suffix.lower() in IMAGE_SUFFIXES and p.name[0] != ".")
        return sorted(images, key=lambda path: files.natural_order(path.name.lower()))

    def _whole_file(self, path: Path) -> bytes | None:
        """The file's content, or None while it is being written. Raises InputError for one that never gets whole."""
        version = data = None
        trouble = "damaged, its end is missing"
        try:
            state = path.stat()
            version = (state.st_size, state.st_mtime_ns)
            data = path.read_bytes()
        except OSError as error:  # locked by its writer, renamed, or never to be read
            if not self._folder and not os.path.exists(path):
                self._seen.add(str(path))
                raise InputError(f"{path}: image not found; check the path.") from error
            trouble = f"cannot be read ({error.strerror})"
        now = self._clock()
        before, since_s = self._unfinished.get(path, (None, now))
        if version != before:
            since_s = now
        whole = data is not None and _has_its_end(data, path.suffix.lower())
        if whole or (whole is None and version == before and now - since_s >= 0.2):
            self._unfinished.pop(path, None)
            return data
        self._unfinished[path] = (version, since_s)
        if now - since_s > DAMAGED_AFTER_S:
            self._seen.add(str(path))
            del self._unfinished[path]
            raise InputError(f"{path}: {trouble}; it is left out.")
        return None


class VideoFile:
    """A video at its own speed; frames that are late are left out and counted.

    given: pose of each frame (by number) that was registered before.
    """

    def __init__(
        self,
        path: Path,
        repeat: bool = False,
        clock: Callable[[], float] = time.monotonic,
        given: dict[int, Prediction] | None = None,
    ):
        self._path, self._repeat, self._clock, self._given = Path(path), repeat, clock, given or {}
        self.dropped = 0
        self.can_wait = True
        self._capture = None

    def open(self) -> None:
        if not os.path.isfile(self._path):
            raise SourceLost(f"{self._path}: video not found; check the path, or wait for its drive to return.")
        import cv2

        files.require_text(self._path)
        self._capture = cv2.VideoCapture(str(self._path))
        if not self._capture.isOpened():
            self.close()
            raise InputError(f"{self._path}: not a video that OpenCV can read; save it as MP4 (H.264) or AVI.")
        rate_hz = self._capture.get(cv2.CAP_PROP_FPS)
        self._interval_s = 1 / (rate_hz if 0 < rate_hz < 1000 else USUAL_RATE_HZ)
        self._due_s = self._clock()
        self._number, self._read_any = 0, False

    def read(self) -> LiveFrame | None:
        now = self._clock()
        if now < self._due_s:
            return None
        while now - self._due_s > self._interval_s and self._capture.grab():
            self._due_s += self._interval_s
            self._number += 1
            self.dropped += 1
        ok, image = self._capture.read()
        self._due_s += self._interval_s
        if not ok:
            if not self._read_any:
                raise SourceLost(f"{self._path}: no frame of this video can be read; save it again as MP4 or AVI.")
            if not self._repeat:
                raise SourceEnded("the video has ended.")
            self.close()
            self.open()
            return None
        self._read_any = True
        number, self._number = self._number, self._number + 1
        rgb = np.ascontiguousarray(image[..., ::-1])
        return LiveFrame(rgb, self._clock(), number, f"{number}", self._given.get(number))

    def go_on(self) -> None:
        self._due_s = self._clock()

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None


class CaptureDevice:
    """A camera or frame grabber by its number, or the address of a network stream; the newest frame each time.

    size_px: width and height that it is asked for; it may have others.
    """

    def __init__(self, device: int | str, size_px: tuple[int, int] | None = None):
        self._device, self._size_px = device, size_px
        self.dropped = 0
        self.can_wait = False
        self._number = 0
        self._capture = None

    def open(self) -> None:
        import cv2

        self._capture = cv2.VideoCapture(self._device)
        if not self._capture.isOpened():
            self.close()
            raise SourceLost(
                f"capture device {self._device}: cannot be opened; check that it is plugged in and that no other "
                "program uses it."
            )
        if self._size_px is not None:  # drivers start with 640 x 480, whatever they can
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size_px[0])
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size_px[1])
        self._capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # without it some drivers hand out frames that are long past

    def read(self) -> LiveFrame | None:
        ok, image = self._capture.read()  # waits for the next frame
        if not ok:
            raise SourceLost(f"capture device {self._device}: gives no picture any more; check its cable.")
        self._number += 1
        if image.ndim == 3 and image.shape[2] == 3:
            image = np.ascontiguousarray(image[..., ::-1])
        return LiveFrame(image, time.monotonic(), self._number - 1, f"{self._number - 1}")

    def go_on(self) -> None:
        """Nothing was missed that could be had."""

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()
            self._capture = None


def _has_its_end(data: bytes, suffix: str) -> bool | None:
    """Whether the file is whole; None where the format has no mark at its end."""
    if suffix == ".png":
        return b"IEND" in data[-16:]
    if suffix in (".jpg", ".jpeg"):
        return b"\xff\xd9" in data[-64:]
    return None


def _decoded(data: bytes, path: Path) -> np.ndarray:
    import cv2

    image = files.decoded(data, cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: not an image that can be read (or damaged); it is left out.")
    return np.ascontiguousarray(image[..., ::-1])
