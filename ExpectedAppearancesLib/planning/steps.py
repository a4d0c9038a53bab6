"""How far a case is: for each step of planning whether it is done, outdated or missing something, and why.

Nothing here reads files or knows a panel: `plan_steps` maps what is chosen and what the case holds to the answer.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from ..case.case import pose_settings
from ..geometry.camera import Camera
from ..model.presets import PRESETS

STEPS = ("case", "microscope", "poses", "textures", "appearances", "training", "validation")
FEW_TEXTURES = 6  # fewer teach the network these textures rather than cortex
LENGTH_TOLERANCE_MM = 0.05  # what is typed into a field is rounded to this
ANGLE_TOLERANCE_DEG = 0.05
RANGE_NAMES = {
    "tilt_max_deg": "the tilt",
    "roll_max_deg": "the roll",
    "working_distance_mm": "the working distance",
    "lateral_offset_mm": "the lateral offset",
    "in_view_min": "the share of vessels in view",
}


class StepState(Enum):
    MISSING = "missing"  # something must be chosen or done before
    READY = "ready"  # all is there, it only has to be started
    RUNNING = "running"
    STALE = "stale"  # done, but something it was made from has changed
    DONE = "done"


@dataclass(frozen=True)
class Step:
    """State of one step, and a sentence that says why in the user's words."""

    state: StepState
    text: str


class Study(Enum):
    """How the last study of the case ended."""

    NONE = "none"
    STOPPED = "stopped"
    DONE = "done"


@dataclass(frozen=True)
class Chosen:
    """What is chosen in the panel now.

    changed: names of the inputs ("vessel model", ...) that differ from those of the case. camera: None where it is not
    given or wrong, then camera_problem says why. poses: {"poses", "seed", "ranges", "craniotomy"} as `render` records
    them, None where they cannot be had. textures: name -> SHA-256 of image and labels, "" while it has not been read.
    synthesis: {"size_px", "iterations"}. running: kinds of runs that go on. scan_unsaved: the chosen MRI is not in the
    case, which changes nothing that is made from it. waiting: what is still being worked out of the models, '' if
    nothing is; what the case says of them is not known so long. minutes: longest training, 0 where it is not known.
    """

    folder: str = ""
    has_vessels: bool = False
    changed: tuple[str, ...] = ()
    camera: Camera | None = None
    camera_problem: str = ""
    poses: dict | None = None
    poses_problem: str = ""
    textures: dict[str, str] = field(default_factory=dict)
    textures_problem: str = ""
    synthesis: dict = field(default_factory=dict)
    preset: str = ""
    running: frozenset[str] = frozenset()
    scan_unsaved: bool = False
    waiting: str = ""
    minutes: float = 0.0


@dataclass(frozen=True)
class Recorded:
    """What the case folder holds: case.json, the camera, the index of the appearances, model.json; None where absent.

    overview_changed: the view that method `surface` synthesises on is another one now. poses_changed: those that method
    `image` synthesises on are. appearances_sha256: of the index. steps_trained: of a training that was stopped, 0 where
    there is none. validation: whether figures are there, verdict of `evaluation.verdict` on them: (ready, reasons).
    study_preset: {"name", "minutes"} of the last study's models, as far as its run was told.
    """

    problem: str = ""
    manifest: dict | None = None
    camera: Camera | None = None
    index: dict | None = None
    overview_changed: bool = False
    model: dict | None = None
    appearances_sha256: str = ""
    steps_trained: int = 0
    validation: str = ""
    verdict: tuple[bool, tuple[str, ...]] | None = None
    study: Study = Study.NONE
    poses_changed: bool = False
    study_preset: dict = field(default_factory=dict)


def plan_steps(chosen: Chosen, recorded: Recorded) -> dict[str, Step]:
    """State of each of STEPS. A step whose predecessor is outdated is outdated too, or waits for it, and says which."""
    steps = {
        "case": _case(chosen, recorded),
        "microscope": _microscope(chosen, recorded),
        "poses": _poses(chosen, recorded),
        "textures": _textures(chosen),
        "appearances": _appearances(chosen, recorded),
        "training": _training(chosen, recorded),
        "validation": _validation(chosen, recorded),
    }
    names = {"case": "the case", "microscope": "the microscope", "poses": "the poses"}
    names |= {"appearances": "the expected appearances", "training": "the model"}
    before: list[str] = []
    for name in STEPS:
        step = steps[name]
        if step.state is StepState.DONE and before and name not in ("microscope", "textures"):
            steps[name] = Step(StepState.STALE, f"Outdated: {names[before[0]]} changed, see above.")
        if step.state is StepState.READY and before and name in ("poses", "appearances", "training"):
            steps[name] = Step(StepState.MISSING, f"First {names[before[0]]}, see above.")
        if steps[name].state is not StepState.DONE and name in names and not (name == "case" and chosen.waiting):
            before.append(name)
    return steps


def next_step(steps: dict[str, Step]) -> str:
    """The first step that is not done; the last one when all are."""
    return next((name for name in STEPS if steps[name].state is not StepState.DONE), STEPS[-1])


def changes_of_poses(chosen: dict, recorded: dict) -> list[str]:
    """What differs between two pose settings, in the user's words."""
    changed = []
    if chosen["poses"] != recorded.get("poses"):
        changed.append("the number of poses")
    if chosen["seed"] != recorded.get("seed"):
        changed.append("the seed")
    return changed + _changes_of_views(chosen, recorded)


def _changes_of_views(chosen: dict, recorded: dict) -> list[str]:
    """What differs of where the poses lie, however many there are."""
    changed = []
    for key, name in RANGE_NAMES.items():
        tolerance = 0.005 if key == "in_view_min" else LENGTH_TOLERANCE_MM
        if not _close(chosen["ranges"].get(key), recorded.get("ranges", {}).get(key), tolerance):
            changed.append(name)
    if craniotomy_moved(chosen["craniotomy"], recorded.get("craniotomy")):
        changed.append("the craniotomy")
    return changed


def craniotomy_moved(first: dict, second: dict | None) -> bool:
    """Whether two craniotomies, as recorded by `render`, differ by more than what rounding does."""
    if second is None:
        return True
    axis = np.radians(ANGLE_TOLERANCE_DEG)
    return not (
        _close(first["centre_world_mm"], second["centre_world_mm"], LENGTH_TOLERANCE_MM)
        and _close(first["outward_axis"], second["outward_axis"], axis)
    )


def drawn_from_elsewhere(poses: dict, manifest: dict) -> bool:
    """Whether the poses of a training or study, as far as it says which they were, are not those that `render` has
    recorded since."""
    now = pose_settings(manifest)
    known = {key: poses.get(key) or now[key] for key in now}
    return all(now.values()) and bool(_changes_of_views(known, now))


def changes_of_textures(chosen: dict[str, str], index: dict) -> list[str]:
    """Which textures were added, removed or changed since the appearances of `index` were made."""
    made = {item["style"]: item.get("texture_sha256") for item in index["items"]}
    changes = [f"{name} was added" for name in chosen if name not in made]
    changes += [f"{name} was removed" for name in made if name not in chosen]
    # Without a digest, of one that is not read yet or in a case of an older version, nothing can be said.
    return changes + [f"{n} was changed" for n in made if made[n] and chosen.get(n) and chosen[n] != made[n]]


def changes_of_training(preset: str, minutes: float, before: dict) -> list[str]:
    """What differs from the {"name", "minutes"} with which a training or study was stopped: all of it begins anew."""
    if preset and before.get("name") and preset != before["name"]:
        return [f"the preset (was {before['name']})"]
    if minutes and before.get("minutes") and not _close(minutes, before["minutes"], 1e-3):
        return [f"the time (was {before['minutes']:g} min)"]
    return []


def _case(chosen: Chosen, recorded: Recorded) -> Step:
    if chosen.waiting:
        return Step(StepState.RUNNING, chosen.waiting)
    if recorded.problem:
        return Step(StepState.MISSING, recorded.problem)
    if not chosen.has_vessels and recorded.manifest is None:
        return Step(StepState.MISSING, "Choose the vessel model, or open a case.")
    if not chosen.folder:
        return Step(StepState.MISSING, "Choose a folder for the case: New or Open.")
    if recorded.manifest is None:
        if chosen.camera is None:
            return Step(StepState.MISSING, "Give the microscope in the next section, then save the case.")
        return Step(StepState.READY, "All is there: save the case.")
    changed = list(chosen.changed)
    if chosen.camera is not None and _camera_changed(chosen, recorded):
        changed.append("microscope")
    if changed:
        return Step(StepState.STALE, f"Changed since the case was saved: {_listed(changed)}. Save the case again.")
    if chosen.scan_unsaved:
        return Step(StepState.DONE, "Saved, but without the MRI that is chosen now: save again to add it.")
    return Step(StepState.DONE, "Saved.")


def _microscope(chosen: Chosen, recorded: Recorded) -> Step:
    if chosen.camera is None:
        return Step(StepState.MISSING, chosen.camera_problem or "Choose a calibration file.")
    if recorded.camera is not None and _camera_changed(chosen, recorded):
        return Step(StepState.STALE, "Differs from the microscope of the saved case. Save the case again.")
    if recorded.manifest is None:
        return Step(StepState.READY, "Given; it is saved with the case.")
    return Step(StepState.DONE, "Saved with the case.")


def _poses(chosen: Chosen, recorded: Recorded) -> Step:
    if "render" in chosen.running:
        return Step(StepState.RUNNING, "Label maps are being drawn.")
    if chosen.poses is None:
        return Step(StepState.MISSING, chosen.poses_problem or "Choose the vessel model and the microscope first.")
    if recorded.manifest is None:
        return Step(StepState.MISSING, "Save the case first.")
    render = recorded.manifest["stages"].get("render", {})
    if not render:
        return Step(StepState.READY, "Look at the cameras, then draw the label maps.")
    changed = changes_of_poses(chosen.poses, render)
    if changed:
        return Step(StepState.STALE, f"Changed since the label maps were drawn: {_listed(changed)}. Draw them again.")
    if not render.get("done"):
        return Step(StepState.READY, "Drawing was stopped; it goes on where it was.")
    return Step(StepState.DONE, f"{render['poses']} label maps drawn.")


def _textures(chosen: Chosen) -> Step:
    if chosen.textures_problem:
        return Step(StepState.MISSING, chosen.textures_problem)
    count = len(chosen.textures)
    if not count:
        return Step(StepState.MISSING, "The folder holds no textures: add photographs, or use the shipped ones.")
    if count < FEW_TEXTURES:
        return Step(
            StepState.DONE,
            f"Only {_counted(count, 'texture')}: with fewer than {FEW_TEXTURES} the model will know these pictures "
            "rather than cortex. Add photographs.",
        )
    return Step(StepState.DONE, f"{count} textures.")


def _appearances(chosen: Chosen, recorded: Recorded) -> Step:
    if "synthesize" in chosen.running:
        return Step(StepState.RUNNING, "Expected appearances are being made.")
    stages = recorded.manifest["stages"] if recorded.manifest else {}
    if not stages.get("render", {}).get("done"):
        return Step(StepState.MISSING, "Draw the label maps first (Craniotomy and poses).")
    index = recorded.index
    if not index:
        if not chosen.textures or chosen.textures_problem:
            return Step(StepState.MISSING, "Choose textures first.")
        return Step(StepState.READY, "All is there: start.")
    changed = []
    for key, name in (("size_px", "the size"), ("iterations", "the number of iterations")):
        if key in chosen.synthesis and index["settings"].get(key) not in (None, chosen.synthesis[key]):
            changed.append(name)
    if recorded.overview_changed:
        changed.append("the craniotomy")
    if recorded.poses_changed:
        changed.append("the poses")
    if index["done"] and not chosen.textures_problem:  # of what cannot be read nobody knows whether it changed
        textures = changes_of_textures(chosen.textures, index)
        changed += textures if len(textures) <= 2 else ["the textures"]
    if changed:
        return Step(StepState.STALE, f"Changed since they were made: {_listed(changed)}. Start makes what is missing.")
    if not index["done"]:
        return Step(StepState.READY, "Stopped; Continue goes on where it was.")
    return Step(StepState.DONE, f"{_counted(len(index['items']), 'expected appearance')} made.")


def _training(chosen: Chosen, recorded: Recorded) -> Step:
    if "train" in chosen.running:
        return Step(StepState.RUNNING, "The model is being trained.")
    if not recorded.index or not recorded.index["done"]:
        return Step(StepState.MISSING, "Make the expected appearances first.")
    stages = recorded.manifest["stages"]
    train = stages.get("train", {})
    if not train.get("done"):
        if recorded.steps_trained:
            stopped = f"Stopped after step {recorded.steps_trained}"
            changed = changes_of_training(chosen.preset, chosen.minutes, train.get("preset", {}))
            if train.get("appearances_sha256") not in (None, recorded.appearances_sha256):
                changed.append("the expected appearances")
            if train.get("poses") not in (None, pose_settings(recorded.manifest)):
                changed.append("the poses")
            changed += _options_of_the_command(train)
            if changed:
                return Step(StepState.READY, f"{stopped}. Changed since: {_listed(changed)}; so it begins anew.")
            return Step(StepState.READY, f"{stopped}; Continue goes on from there.")
        return Step(StepState.READY, "All is there: start.")
    changed = []
    if _appearances_changed(stages, train, recorded.appearances_sha256):
        changed.append("the expected appearances")
    render = stages.get("render")
    other_view = recorded.model and recorded.model.get("plausible_view") and _view_changed(recorded.model, render)
    if other_view or drawn_from_elsewhere(train.get("poses") or {}, recorded.manifest):
        changed.append("the poses")
    trained = train.get("preset", {}).get("name", "")
    if chosen.preset and trained and chosen.preset != trained:
        changed.append(f"the preset (trained with {trained})")
    if recorded.model is None:
        return Step(StepState.MISSING, "The trained model is gone from the case folder; train again.")
    if changed:
        return Step(StepState.STALE, f"Changed since the training: {_listed(changed)}. Train again.")
    return Step(StepState.DONE, f"Trained with preset {trained}.")


def _options_of_the_command(train: dict) -> list[str]:
    """What a training was told that a panel has no field for: with the usual values it is another training."""
    preset = train.get("preset", {})
    usual = PRESETS.get(preset.get("name"))
    options = ["the seed"] if train.get("seed") else []
    # A regression's steps come from the number of images.
    if usual and usual.estimator == "dense" and preset.get("steps") not in (None, usual.steps):
        options.append("the number of steps")
    return options


def _validation(chosen: Chosen, recorded: Recorded) -> Step:
    if "study" in chosen.running:
        return Step(StepState.RUNNING, "A study is going on: for each texture a model is trained without it.")
    if recorded.verdict is None:
        if recorded.study is Study.STOPPED:
            changed = changes_of_training(chosen.preset, chosen.minutes, recorded.study_preset)
            if changed:
                return Step(
                    StepState.READY, f"The study was stopped. Changed since: {_listed(changed)}; so it begins anew."
                )
            return Step(StepState.READY, "The study was stopped; it goes on where it was.")
        if recorded.model is not None:
            return Step(StepState.MISSING, "No figures yet.")
        possible = recorded.index is not None and recorded.index["done"]
        return Step(StepState.MISSING, "Train the model, or start a study." if possible else "Train the model first.")
    ready, reasons = recorded.verdict
    if recorded.validation == "stale":
        return Step(StepState.STALE, "The study is about an older model of this case, or one of another preset.")
    if ready:
        return Step(StepState.DONE, "Ready: all limits are met.")
    return Step(StepState.MISSING, f"Not ready: {_counted(len(reasons), 'limit')} of 3 not met.")


def _camera_changed(chosen: Chosen, recorded: Recorded) -> bool:
    first, second = chosen.camera.to_dict(), recorded.camera.to_dict()
    first["distortion"], second["distortion"] = (
        (list(values["distortion"]) + [0.0] * 14)[:14] for values in (first, second)
    )
    return not all(_close(first[key], second[key], 1e-3 if key != "distortion" else 1e-9) for key in first)


def _appearances_changed(stages: dict, train: dict, appearances_sha256: str) -> bool:
    if train.get("appearances_sha256"):
        return train["appearances_sha256"] != appearances_sha256
    return stages.get("synthesize", {}).get("updated", "") > train.get("updated", "")


def _view_changed(model: dict, render: dict | None) -> bool:
    if not render:
        return True
    view, ranges, craniotomy = model["plausible_view"], render["ranges"], render["craniotomy"]
    return not (
        _close(view["centre_world_mm"], craniotomy["centre_world_mm"], LENGTH_TOLERANCE_MM)
        and _close(view["outward_axis"], craniotomy["outward_axis"], np.radians(ANGLE_TOLERANCE_DEG))
        and _close(view["tilt_max_deg"], ranges["tilt_max_deg"], ANGLE_TOLERANCE_DEG)
        and _close(view["distance_mm"], ranges["working_distance_mm"], LENGTH_TOLERANCE_MM)
    )


def _close(first, second, tolerance: float) -> bool:
    if first is None or second is None:
        return first is second
    return bool(np.allclose(np.asarray(first, float), np.asarray(second, float), rtol=0, atol=tolerance))


def _listed(words: list[str]) -> str:
    shown = words[:3] + ([f"and {len(words) - 3} more"] if len(words) > 3 else [])
    return ", ".join(shown)


def _counted(count: int, noun: str) -> str:
    return f"1 {noun}" if count == 1 else f"{count} {noun}s"
