"""Files that are whole or absent: every write goes to a neighbour first and is renamed into place."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from .errors import InputError

READERS_TAKE_S = 2.0  # at most, for a file


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Within the block, an OSError becomes an InputError that names `path` and the way out."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); "
            "free some space or choose a folder you may write to."
        ) from error


@contextlib.contextmanager
def reading(path: Path) -> Iterator[None]:
    """Within the block, an OSError becomes an InputError that names `path` and the way out."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or error}); check its drive, and that you may read it."
        ) from error


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary neighbour of `path` (same suffix) that replaces it if the block succeeds.

    Raises InputError naming `path` when it cannot be written or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            # Else a loss of power may leave an empty file of this name, and of the one before nothing.
            with open(temporary, "rb+") as stream:
                os.fsync(stream.fileno())
            _replace(temporary, path)
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def _replace(temporary: Path, path: Path) -> None:
    """os.replace, which on Windows fails as long as another process reads `path`, as the panel does now and then."""
    deadline = time.monotonic() + READERS_TAKE_S
    while True:
        try:
            os.replace(temporary, path)
            return
        except PermissionError:
            if path.is_dir() or time.monotonic() > deadline:
                raise
            time.sleep(0.02)


def write_bytes(path: Path, data: bytes) -> None:
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_json(path: Path, value) -> None:
    text = json.dumps(value, indent=1, ensure_ascii=False) + "\n"
    # On Linux a file's name may be no text: half of a surrogate pair, which JSON has an escape for and UTF-8 not.
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def read_json(path: Path, what: str):
    """Parsed JSON of `path`; `what` names the content in the error message. Raises InputError."""
    path = Path(path)
    if not os.path.isfile(path):  # unlike pathlib's, False on a network drive that is gone
        raise InputError(f"{path}: {what} not found; check the path.")
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))  # Windows' editors put a mark before the text
    except (ValueError, OSError) as error:
        raise InputError(f"{path}: {what} cannot be read as JSON ({error}); make the file again.") from error


def write_png(path: Path, image: np.ndarray) -> None:
    """Write uint8 (H, W) or RGB (H, W, 3), or uint16 (H, W), as PNG."""
    import cv2

    ok, data = cv2.imencode(".png", image[..., ::-1] if image.ndim == 3 else image)
    if not ok:
        raise ValueError(f"{path}: image of shape {image.shape} {image.dtype} cannot be encoded")
    write_bytes(path, data.tobytes())


def read_image_rgb(path: Path) -> np.ndarray:
    """Image file (PNG, JPEG, TIFF, 8 or 16 bit, grey or colour) as uint8 RGB (H, W, 3). Raises InputError."""
    import cv2

    path = Path(path)
    if not os.path.isfile(path):
        raise InputError(f"{path}: image not found; check the path.")
    with reading(path):
        image = decoded(path.read_bytes(), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: not an image that can be read (or damaged); give a PNG, JPEG or TIFF file.")
    return np.ascontiguousarray(image[..., ::-1])


def decoded(data: bytes, mode: int) -> np.ndarray | None:
    """As cv2.imread of a file that holds `data`, which fails on non-ASCII paths on Windows; None for what is no
    image."""
    import cv2

    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), mode) if data else None
    except cv2.error:  # the size that a damaged header tells
        return None


def read_label_map(path: Path) -> np.ndarray:
    """Single-channel label PNG as uint8 (H, W). Raises InputError."""
    import cv2

    path = Path(path)
    if not os.path.isfile(path):
        raise InputError(f"{path}: label map not found; check the path.")
    with reading(path):
        labels = decoded(path.read_bytes(), cv2.IMREAD_UNCHANGED)
    if labels is None:
        raise InputError(f"{path}: label map cannot be read (or damaged); save it as an 8-bit grey PNG.")
    if labels.ndim == 3:
        if np.ptp(labels[..., :3].astype(int), axis=2).any():
            raise InputError(f"{path}: label map is a colour image; save it as an 8-bit grey PNG with values 0, 1, 2.")
        labels = labels[..., 0]
    if labels.max() > 255:  # 256 would be read as 0
        raise InputError(
            f"{path}: label map holds the value {labels.max()}; save it as an 8-bit grey PNG with values 0, 1, 2."
        )
    return labels.astype(np.uint8)


def natural_order(name: str) -> list:
    """Key that sorts names by the numbers in them: frame_9 before frame_10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", name)]


def sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with open(path, "rb") as stream:
        for block in iter(lambda: stream.read(1 << 20), b""):
            digest.update(block)
    return digest.hexdigest()


def require_text(path: Path) -> None:
    """Raise InputError for a path that is no text, as old archives leave some on Linux: onnxruntime cannot read there,
    and OpenCV's videos crash."""
    try:
        str(path).encode("utf-8")
    except UnicodeEncodeError:
        raise InputError(
            f"{path}: this name, or that of a folder above it, is not in UTF-8; rename it without special letters."
        ) from None


def existing_parent(path: Path) -> Path:
    """The nearest folder above `path` that is there; the drive itself where Windows does not know it (any more)."""
    return next((folder for folder in path.parents if folder.exists()), Path(path.anchor))


def require_writable(folder: Path) -> None:
    """Raise InputError where nothing can be made in `folder`, or in the nearest one above it that is there."""
    existing = existing_parent(Path(folder).absolute() / "file")
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise InputError(f"{existing}: nothing can be written here; choose a folder you may write to.")


def require_space(folder: Path, needed_mb: float) -> None:
    """Raise InputError when the disk of `folder` (or its nearest existing parent) has less than `needed_mb` free."""
    folder = existing_parent(Path(folder).absolute() / "file")
    free_mb = shutil.disk_usage(folder).free / 2**20
    if free_mb < needed_mb:
        raise InputError(
            f"{folder}: {free_mb:.0f} MB free, about {needed_mb:.0f} MB needed; free some space or choose another disk."
        )
