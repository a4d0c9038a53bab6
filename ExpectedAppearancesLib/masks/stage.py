"""The `render` stage: sampled poses and their label maps, written into the case."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable

import numpy as np

from .. import files
from ..case.case import Case
from ..case.meshes import Mesh
from ..errors import InputError
from ..poses.craniotomy import Craniotomy, find_craniotomy, parenchyma_around
from ..poses.sampling import PoseRanges, PoseSampler
from .labels import VESSELS
from .renderer import MaskRenderer

DEFAULT_POSES = 100


def craniotomy_of(case: Case) -> Craniotomy:
    """The craniotomy recorded by `render`, else found from the case's meshes."""
    recorded = case.manifest["stages"].get("render", {}).get("craniotomy")
    if recorded:
        return Craniotomy(*(np.array(recorded[key], float) for key in ("centre_world_mm", "outward_axis", "up")))
    return find_craniotomy(case.vessels, case.cortex, case.space)


def parenchyma_of(case: Case, craniotomy: Craniotomy) -> Mesh:
    return parenchyma_around(case.vessels, case.cortex, craniotomy.outward_axis)


def pose_ranges_of(case: Case) -> PoseRanges:
    recorded = case.manifest["stages"].get("render", {}).get("ranges")
    return PoseRanges.from_dict(recorded) if recorded else PoseRanges()


def sampler_of(case: Case, seed: int) -> PoseSampler:
    """Fresh poses in the ranges that `render` recorded."""
    return PoseSampler(craniotomy_of(case), pose_ranges_of(case), case.camera, case.vessels.vertices_mm, seed)


def read_rendered(case: Case) -> list[dict]:
    """[{"labels": Path, "camera_from_world": (4, 4)}] of the stage. Raises InputError when it has not run."""
    if not case.poses_path.is_file():
        raise InputError(f"{case.folder}: no poses and label maps yet; run `render` first.")
    content = files.read_json(case.poses_path, "poses")
    frames = [
        {
            "labels": case.poses_path.parent / frame["labels"],
            "camera_from_world": np.array(frame["camera_from_world"], float),
        }
        for frame in content["frames"]
    ]
    missing = [str(f["labels"]) for f in frames if not f["labels"].is_file()]
    if missing:
        raise InputError(f"{missing[0]}: label map missing ({len(missing)} in all); run `render` again.")
    return frames


def render_case(
    case: Case,
    progress: Callable[[float, str], None],
    poses: int = DEFAULT_POSES,
    seed: int = 0,
    ranges: PoseRanges | None = None,
    craniotomy: Craniotomy | None = None,
    circular_field: float | None = None,
) -> None:
    """Sample `poses` poses and write their label maps; goes on where an interrupted run of the settings stopped."""
    if poses < 1:
        raise InputError(f"poses: {poses}; give at least 1.")
    if circular_field is not None and not 0 < circular_field <= 1:
        raise InputError(f"circular field: {circular_field}; give its radius as a share of the image's height, 0 to 1.")
    craniotomy = craniotomy or find_craniotomy(case.vessels, case.cortex, case.space)
    sampler = PoseSampler(craniotomy, ranges or PoseRanges(), case.camera, case.vessels.vertices_mm, seed)
    matrices = [sampler.sample(i) for i in range(poses)]
    files.require_space(case.folder, poses * 0.02 + 5)
    settings = {
        "poses": poses,
        "seed": seed,
        "ranges": sampler.ranges.to_dict(),
        "circular_field": circular_field,
        "craniotomy": {key: np.asarray(value).tolist() for key, value in vars(craniotomy).items()},
    }
    settings = json.loads(json.dumps(settings))
    if _without_count(case.manifest["stages"].get("render")) != _without_count(settings):
        # The poses first: new label maps must not be taken for what the old poses see.
        for stale in (case.poses_path, *case.masks_folder.glob("*.png")):
            stale.unlink(missing_ok=True)
    case.record("render", **settings, done=False)
    shows_vessels = False
    with MaskRenderer(case.vessels, parenchyma_of(case, craniotomy), case.camera, circular_field) as renderer:
        for i, matrix in enumerate(matrices):
            path = case.masks_folder / f"{i:05d}.png"
            labels = None
            with contextlib.suppress(InputError):  # missing, or left empty by a loss of power
                labels = files.read_label_map(path)
            if labels is None:
                labels = renderer.render(matrix)
                files.write_png(path, labels)
            shows_vessels = shows_vessels or bool((labels == VESSELS).any())
            progress((i + 1) / poses, f"label map {i + 1} of {poses}")
    if not shows_vessels:
        raise InputError(
            f"{case.folder}: none of the label maps shows a vessel, the cortex hides them all; make the case with a "
            "cortex that does not lie over them, or with none, or give the axis that points out of the head."
        )
    frames = [
        {"labels": f"../masks/{i:05d}.png", "camera_from_world": matrix.tolist()} for i, matrix in enumerate(matrices)
    ]
    files.write_json(case.poses_path, {"camera": case.camera.to_dict(), "frames": frames})
    case.record("render", done=True)


def _without_count(settings: dict | None) -> dict | None:
    """What decides the content of label map i: everything but how many there are."""
    if settings is None:
        return None
    return {key: settings.get(key) for key in ("seed", "ranges", "circular_field", "craniotomy")}
