"""Opening a case in the panel: its models come into the scene, its settings into the panel's parameters."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Generator, Iterator
from pathlib import Path

from ..case.case import MANIFEST_NAME, Case
from ..errors import InputError
from ..planning.steps import LENGTH_TOLERANCE_MM
from ..poses.sampling import PoseRanges
from .mri import scan_of
from .planning import remove_nodes, same_mesh, world_mesh
from .planning_session import PlanningSession
from .scene import CORTEX, VESSELS, add_case_model

CASE_ATTRIBUTE = "ExpectedAppearances.CaseInput"


def adopting(
    session: PlanningSession, parameters, folder: str, scene, warn: Callable[[str], None]
) -> Generator[None, None, Case | None]:
    """Take the case in `folder` into scene and panel, a piece at each step; None where none can be opened there.

    warn: called with the text, where the case's MRI is missing or damaged. Closed before its end it leaves nothing in
    the scene.
    """
    case = session.reader.case(folder)[0]
    yield
    if case is None:
        with _at_once(parameters):
            parameters.casePath = folder
            parameters.vesselsNode = parameters.cortexModel = parameters.mriVolume = None
        return None
    added: list = []
    left = (parameters.vesselsNode, parameters.cortexModel) if parameters.casePath not in ("", folder) else ()
    try:
        for name in ("vessels", "cortex"):
            getattr(case, name)  # read, and kept
            yield
        nodes = yield from _models(scene, case, added)
        scan = None
        try:
            count = scene.GetNumberOfNodesByClass("vtkMRMLScalarVolumeNode")
            scan = scan_of(scene, case)
            added += [scan] if scene.GetNumberOfNodesByClass("vtkMRMLScalarVolumeNode") > count else []
        except InputError as error:  # all else can be worked with
            warn(str(error))
        yield
        automatic = PoseRanges().resolved(case.camera, case.vessels.radius_mm)
        yield
    except GeneratorExit:
        remove_nodes(scene, dict(enumerate(added)))
        raise
    with _at_once(parameters):
        parameters.casePath = folder
        parameters.vesselsNode, parameters.cortexModel = nodes[VESSELS], nodes.get(CORTEX)
        parameters.mriVolume = scan
        _adopt_settings(parameters, case, automatic)
    for node in filter(None, (*left, *nodes.values())):  # two patients are not seen in one place
        node.SetDisplayVisibility(node in nodes.values())
    yield from session.prepare(parameters)
    if parameters.craniotomySource.value == "recorded" and session.is_fitted(parameters):
        parameters.craniotomySource = type(parameters.craniotomySource)("fitted")
    return case


def _adopt_settings(parameters, case: Case, automatic: PoseRanges) -> None:
    parameters.cameraSource = type(parameters.cameraSource)("file")
    parameters.calibrationPath = str(case.folder / case.manifest["inputs"]["camera"]["file"])
    stages = case.manifest["stages"]
    # A mark is that of the patient before.
    parameters.craniotomySource = type(parameters.craniotomySource)("fitted")
    if stages.get("render"):
        _adopt_poses(parameters, stages["render"], automatic)
    synthesize = stages.get("synthesize", {})
    if synthesize.get("method"):
        parameters.method = type(parameters.method)(synthesize["method"])
        _take(parameters, "sizePx", synthesize.get("size_px"))
        _take(parameters, "iterations", synthesize.get("iterations"))
    preset = stages.get("train", {}).get("preset", {})
    if preset.get("name") in [choice.value for choice in type(parameters.preset)]:
        parameters.preset = type(parameters.preset)(preset["name"])
        _take(parameters, "minutes", preset.get("minutes"))
    parameters.texturesPath = _textures_of(case, synthesize.get("textures_folder", ""))


def _textures_of(case: Case, made_from: str) -> str:
    """The folder that the appearances were made from, unless that is the case's own, which moves with the case."""
    own = case.folder / "textures"
    elsewhere = made_from and os.path.isdir(made_from) and not (Path(made_from).parent / MANIFEST_NAME).is_file()
    return str(own) if own.is_dir() and not elsewhere else made_from


def _models(scene, case: Case, added: list) -> Generator[None, None, dict]:
    """The case's models in the scene, by name, a piece at each step; those that were not there are put into `added`."""
    found = {}
    for name, key in ((VESSELS, "vessels"), (CORTEX, "cortex")):
        entry = case.manifest["inputs"].get(key)
        for i in range(scene.GetNumberOfNodesByClass("vtkMRMLModelNode")):
            node = scene.GetNthNodeByClass(i, "vtkMRMLModelNode")
            if entry and node.GetAttribute(CASE_ATTRIBUTE) == entry["sha256"] and _is_as_saved(node, case, key):
                found[name] = node
        if entry and name not in found:
            found[name] = add_case_model(scene, case, name)
            found[name].SetAttribute(CASE_ATTRIBUTE, entry["sha256"])
            added.append(found[name])
            yield
    return found


def _is_as_saved(node, case: Case, key: str) -> bool:
    """Whether a model that came from the case, or is a copy of one that did, was neither moved nor changed since."""
    with contextlib.suppress(InputError):
        return same_mesh(world_mesh(node, space=case.space), getattr(case, key))
    return False


def _adopt_poses(parameters, render: dict, automatic: PoseRanges) -> None:
    ranges = PoseRanges.from_dict(render["ranges"])
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
    parameters.craniotomySource = type(parameters.craniotomySource)("recorded")


@contextlib.contextmanager
def _at_once(parameters) -> Iterator[None]:
    """Within the block the parameters' node tells nobody that it changes, at its end once."""
    node = getattr(parameters, "parameterNode", None)
    modifying = node.StartModify() if node else 0
    try:
        yield
    finally:
        if node:
            node.EndModify(modifying)


def _take(parameters, name: str, value) -> None:
    """Set a parameter where there is a value within its bounds; else the step shows in what the case differs."""
    if value is not None:
        with contextlib.suppress(ValueError):
            setattr(parameters, name, type(getattr(parameters, name))(value))
