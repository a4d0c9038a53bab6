"""Test frames of a study that is given none: views of the case's own appearances, at poses that are known."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

from .. import files
from ..appearances.store import index_path, read_appearances
from ..case.case import Case, pose_settings
from ..errors import InputError
from ..model.views import ViewSettings, ViewSource
from ..registration.encoding import network_camera
from ..registration.footage import video_and_number
from ..registration.poses_file import Frame, write_poses

FRAMES_PER_TEXTURE = 24
FRAME_PX = 256  # twice what the networks read
SEED_OFFSET = 9001  # training, inner split and calibration draw their poses from other seeds


def drawn_frames(
    case: Case,
    method: str | None,
    per_texture: int = FRAMES_PER_TEXTURE,
    seed: int = 0,
    progress: Callable[[float, str], None] = lambda _fraction, _message: None,
) -> Path:
    """Path of CASE/study/frames/poses.json, with `per_texture` frames of each texture, which is their 'style'.

    Drawn as training views are, with the microscope's blur, light and noise, but without negatives and deformation.
    With method `surface` all textures are seen from the same fresh poses, with `image` from the poses of their
    appearances. Drawn again only when what they show has changed.
    Raises InputError when no appearances are complete.
    """
    method, appearances = read_appearances(case, method)
    folder = case.folder / "study" / "frames"
    made_of = {
        "appearances_sha256": files.sha256(index_path(case, method)),
        "method": method,
        "per_texture": per_texture,
        "seed": seed,
        "poses": pose_settings(case.manifest),
    }
    path, record = folder / "poses.json", folder / "made_of.json"
    if path.is_file() and _known(record) == made_of:
        return path
    shutil.rmtree(folder, ignore_errors=True)
    textures = sorted({appearance.style for appearance in appearances})
    files.require_space(case.folder, len(textures) * per_texture * 0.15 + 5)
    entries = []
    for t, texture in enumerate(textures):
        source = ViewSource(
            case.folder, ViewSettings(method, FRAME_PX, (texture,), False, 0.0, 0.0, seed + SEED_OFFSET)
        )
        try:
            for i in range(per_texture):
                progress((t + i / per_texture) / len(textures), f"drawing test frames of {texture}")
                view, image = source.view(i), folder / texture / f"{i:03d}.png"
                files.write_png(image, view.image)
                entries.append({"image": image, "camera_from_world": view.camera_from_world, "style": texture})
        finally:
            source.close()
    write_poses(path, network_camera(case.camera, FRAME_PX), entries)
    files.write_json(record, made_of)
    return path


def check_poses(case: Case, method: str | None, unseen: bool, seen: bool) -> None:
    """Raise InputError where frames that are drawn of one texture cannot be at poses that models of the others have
    not seen, or at poses that they have seen. With method `image` each pose is made with every texture (the paper),
    or with one; with `surface` poses are drawn as they are wanted."""
    method, appearances = read_appearances(case, method)
    is_shared = len({appearance.camera_from_world.tobytes() for appearance in appearances}) < len(appearances)
    if method == "image" and is_shared and unseen:
        raise InputError(
            f"{case.folder}: its appearances show the same poses in several textures, so no frame at a pose that is "
            "unseen can be drawn of them; study the protocol loto alone, give frames with --poses, or synthesise with "
            "the method surface."
        )
    if method == "image" and not is_shared and seen:
        raise InputError(
            f"{case.folder}: its appearances show each pose in one texture, so a model without that texture cannot "
            "have seen the pose of a frame of it; study the protocol strict alone, or synthesise with the method "
            "surface."
        )


def digest_of(frames: Sequence[Frame]) -> str:
    """SHA-256 of the files that hold the frames: images are made anew, or corrected, under the names they had."""
    named = {(video_and_number(frame.image) or (frame.image,))[0] for frame in frames}
    return hashlib.sha256("".join(files.sha256(path) for path in sorted(named)).encode()).hexdigest()


def _known(record: Path) -> dict | None:
    try:
        return files.read_json(record, "record of the test frames")
    except InputError:
        return None
