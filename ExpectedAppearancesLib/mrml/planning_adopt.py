"""Opening a case in the panel: its models come into the scene, its settings into the panel's parameters."""

from __future__ import annotations

import contextlib

from ..case.case import Case
from ..case.steps import LENGTH_TOLERANCE_MM
from ..errors import InputError
from ..poses.sampling import PoseRanges
from .mri import scan_of
from .planning_session import PlanningSession
from .scene import CORTEX, VESSELS, add_case_models

CASE_ATTRIBUTE = "ExpectedAppearances.CaseInput"


def adopt(session: PlanningSession, parameters, scene) -> Case | None:
    """Take the case at parameters.casePath into scene and panel; None where there is none that can be opened."""
    parameters.vesselsNode = parameters.cortexModel = None
    case = session.case(parameters)
    if case is None:
        return None
    nodes = models_of(scene, case)
    parameters.vesselsNode, parameters.cortexModel = nodes[VESSELS], nodes.get(CORTEX)
    parameters.mriVolume = None
    with contextlib.suppress(InputError):  # all else can be worked with; the panel says that the MRI is missing
        parameters.mriVolume = scan_of(scene, case)
    parameters.cameraSource = type(parameters.cameraSource)("file")
    parameters.calibrationPath = str(case.folder / case.manifest["inputs"]["camera"]["file"])
    stages = case.manifest["stages"]
    if stages.get("render"):
        _adopt_poses(session, parameters, case, stages["render"])
    synthesize = stages.get("synthesize", {})
    if synthesize.get("method"):
        parameters.method = type(parameters.method)(synthesize["method"])
        _take(parameters, "sizePx", synthesize.get("size_px"))
        _take(parameters, "iterations", synthesize.get("iterations"))
    preset = stages.get("train", {}).get("preset", {})
    if preset.get("name") in [choice.value for choice in type(parameters.preset)]:
        parameters.preset = type(parameters.preset)(preset["name"])
        _take(parameters, "minutes", preset.get("minutes"))
    own_textures = case.folder / "textures"
    parameters.texturesPath = str(own_textures) if own_textures.is_dir() else parameters.texturesPath
    return case


def models_of(scene, case: Case) -> dict:
    """The case's models in the scene, by name; added where they are not there yet."""
    found = {}
    for name, key in ((VESSELS, "vessels"), (CORTEX, "cortex")):
        entry = case.manifest["inputs"].get(key)
        for i in range(scene.GetNumberOfNodesByClass("vtkMRMLModelNode")):
            node = scene.GetNthNodeByClass(i, "vtkMRMLModelNode")
            if entry and node.GetAttribute(CASE_ATTRIBUTE) == entry["sha256"]:
                found[name] = node
        if entry and name not in found:
            added = add_case_models(scene, case)
            for kind, node in added.items():
                node.SetAttribute(CASE_ATTRIBUTE, case.manifest["inputs"][kind.lower()]["sha256"])
            for stale in found.values():
                scene.RemoveNode(stale)
            return added
    return found


def _adopt_poses(session: PlanningSession, parameters, case: Case, render: dict) -> None:
    ranges = PoseRanges.from_dict(render["ranges"])
    automatic = PoseRanges().resolved(case.camera, case.vessels.radius_mm)
    _take(parameters, "tiltMaxDeg", ranges.tilt_max_deg)
    _take(parameters, "rollMaxDeg", ranges.roll_max_deg)
    _take(parameters, "inViewPercent", 100 * ranges.in_view_min)
    parameters.distanceAuto = all(
        abs(a - b) < LENGTH_TOLERANCE_MM for a, b in zip(ranges.working_distance_mm, automatic.working_distance_mm)
    )
    _take(parameters, "nearestMm", ranges.working_distance_mm[0])
    _take(parameters, "farthestMm", ranges.working_distance_mm[1])
    parameters.lateralAuto = abs(ranges.lateral_offset_mm - automatic.lateral_offset_mm) < LENGTH_TOLERANCE_MM
    _take(parameters, "lateralMm", ranges.lateral_offset_mm)
    _take(parameters, "poseCount", render["poses"])
    parameters.seed = render["seed"]
    source = "fitted" if session.is_fitted(parameters) else "recorded"
    parameters.craniotomySource = type(parameters.craniotomySource)(source)


def _take(parameters, name: str, value) -> None:
    """Set a parameter where there is a value within its bounds; else the step shows in what the case differs."""
    if value is not None:
        with contextlib.suppress(ValueError):
            setattr(parameters, name, type(getattr(parameters, name))(value))
