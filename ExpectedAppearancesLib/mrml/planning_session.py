"""What the planning panel works on, without the panel: its parameters and the scene in, steps and files out."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..case.case import Case
from ..case.meshes import Mesh
from ..errors import InputError, Problems
from ..evaluation.verdict import Limits
from ..geometry.camera import Camera, read_camera, write_camera
from ..planning.recorded import CaseReader
from ..planning.steps import Chosen, Recorded, Step, craniotomy_moved, plan_steps
from ..poses.craniotomy import Craniotomy, find_craniotomy, has_own_axis
from ..poses.sampling import PoseRanges, PoseSampler
from ..textures.library import list_textures, problems_of_folder, shipped_textures_folder
from . import mri, planning
from .segment_surface import SegmentSurfaces, segment_version

SURFACE_WAITING = "The surface of the segment is being made."
MODELS = {"vessels": "vessel model", "cortex": "cortex model"}


class PlanningSession:
    """Answers of the panel, computed once for each change of what they depend on.

    `parameters`, everywhere, is the panel's parameter node or anything with the same attributes.
    """

    def __init__(self) -> None:
        self.reader = CaseReader()
        self.texture_digests: dict[tuple, str] = {}  # (name, version of its files) -> SHA-256, or "" without OpenCV
        self.texture_problems: dict[tuple, str] = {}
        self.surfaces: SegmentSurfaces | None = None  # without them surfaces of segments are made at once
        self._kept: dict[str, tuple] = {}

    def case(self, parameters) -> Case | None:
        return self.reader.case(parameters.casePath)[0]

    def space(self, parameters) -> str:
        case = self.case(parameters)
        return case.space if case else "LPS"

    def mesh(self, parameters, name: str) -> Mesh | None:
        """'vessels' or 'cortex' in the case's world: of the chosen node, else the case's. Raises InputError."""
        node = parameters.vesselsNode if name == "vessels" else parameters.cortexModel
        case = self.case(parameters)
        if node is None:
            return getattr(case, name) if case and (name == "vessels" or parameters.vesselsNode is None) else None
        segment_id = parameters.vesselsSegmentId if name == "vessels" else ""
        space = self.space(parameters)
        chosen = (node.GetID(), segment_id, space)
        if name == "vessels" and self.waiting(parameters):
            kept = self._kept.get("mesh.vessels")
            if kept and kept[0][:3] == chosen and kept[1] is not None:
                return kept[1]  # as it was before it was drawn on
            raise InputError(SURFACE_WAITING)
        version = (*chosen, _version_of(node, segment_id))
        made = self.surfaces.made if self.surfaces else (lambda *_segment: None)
        return self._once(
            f"mesh.{name}", version, lambda: planning.world_mesh(node, segment_id, space, made(node, segment_id))
        )

    def waiting(self, parameters) -> str:
        """What is still being worked out of the chosen models, '' if nothing is."""
        wanted = self.surfaces and self.surfaces.wanted(parameters.vesselsNode, parameters.vesselsSegmentId)
        return SURFACE_WAITING if wanted else ""

    def camera(self, parameters) -> Camera:
        """From the calibration file or the field of view. Raises InputError."""
        if parameters.cameraSource.value == "view":
            return Camera.from_field_of_view(
                parameters.imageWidthPx, parameters.imageHeightPx, parameters.fieldOfViewMm, parameters.viewedAtMm
            )
        if not parameters.calibrationPath:
            raise InputError("Choose a calibration file, or give the field of view.")
        path = Path(parameters.calibrationPath)
        version = (str(path), path.stat().st_mtime_ns if os.path.isfile(path) else None)
        try:
            return self._once("camera", version, lambda: read_camera(path))
        except ImportError as error:
            raise InputError(f"{path}: reading OpenCV's calibration needs the Python package cv2.") from error

    def craniotomy(self, parameters) -> Craniotomy:
        """As the panel says: fitted, marked by a point or curve, or as recorded in the case. Raises InputError."""
        vessels, cortex = self._meshes(parameters)
        space, source = self.space(parameters), parameters.craniotomySource.value
        if source == "recorded":
            recorded = self._recorded_craniotomy(parameters)
            if recorded is None:
                raise InputError("No craniotomy is saved in the case yet: let it be fitted to the models, or mark it.")
            return recorded
        if source == "marked":
            node = parameters.craniotomyNode
            if node is None:
                raise InputError("Choose a point or a closed curve on the cortex, or let the craniotomy be fitted.")
            # Moving a point does not change the node's time of modification, so its points tell.
            placed = (node.GetNumberOfDefinedControlPoints(), planning.markup_points_ras(node).tobytes())
            axis = self._fitted_axis(vessels, cortex, space)
            version = (_Same(vessels), _Same(cortex), node.GetID(), placed)
            return self._once(
                "marked", version, lambda: planning.craniotomy_of_markups(node, vessels, cortex, space, axis)
            )
        axis = self._fitted_axis(vessels, cortex, space)
        version = (_Same(vessels), _Same(cortex), space)
        return self._once("fitted", version, lambda: find_craniotomy(vessels, cortex, space, None, axis))

    def _fitted_axis(self, vessels: Mesh, cortex: Mesh | None, space: str) -> np.ndarray:
        """Takes a tenth of a second on a large model, and stays while a point is dragged, or the vessels are moved over
        a cortex that has an axis of its own."""
        version = (_Same(cortex), _Same(vessels))
        own = cortex is not None and self._once("own axis", version, lambda: has_own_axis(cortex, vessels))
        version = (_Same(cortex), None if own else _Same(vessels), space)
        return self._once("axis", version, lambda: find_craniotomy(vessels, cortex, space).outward_axis)

    def ranges(self, parameters) -> PoseRanges:
        distance = (parameters.nearestMm, parameters.farthestMm)
        return PoseRanges(
            parameters.tiltMaxDeg,
            parameters.rollMaxDeg,
            None if parameters.distanceAuto else distance,
            None if parameters.lateralAuto else parameters.lateralMm,
            parameters.inViewPercent / 100,
        )

    def sampler(self, parameters) -> PoseSampler:
        """Raises InputError with everything that is missing or impossible."""
        problems = Problems()
        camera = craniotomy = vessels = None
        with problems.collect():
            camera = self.camera(parameters)
        with problems.collect():
            craniotomy = self.craniotomy(parameters)
            vessels = self.mesh(parameters, "vessels")
        ranges = self.ranges(parameters)
        problems.found.extend(ranges.problems())
        problems.raise_if_any()
        version = (_Same(vessels), _Same(craniotomy), ranges, camera, parameters.seed)
        return self._once(
            "sampler", version, lambda: PoseSampler(craniotomy, ranges, camera, vessels.vertices_mm, parameters.seed)
        )

    def pose_settings(self, parameters) -> dict:
        """As `render` records them, for comparison. Raises InputError."""
        sampler = self.sampler(parameters)
        settings = {
            "poses": parameters.poseCount,
            "seed": parameters.seed,
            "ranges": sampler.ranges.to_dict(),
            "craniotomy": {key: np.asarray(value).tolist() for key, value in vars(sampler.craniotomy).items()},
        }
        return json.loads(json.dumps(settings))

    def render_arguments(self, parameters) -> list[str]:
        """Options of the command `render` for what is chosen. Raises InputError."""
        settings = self.pose_settings(parameters)
        ranges, craniotomy = settings["ranges"], settings["craniotomy"]
        options = {
            "--poses": [settings["poses"]],
            "--seed": [settings["seed"]],
            "--tilt-deg": [ranges["tilt_max_deg"]],
            "--roll-deg": [ranges["roll_max_deg"]],
            "--working-distance-mm": ranges["working_distance_mm"],
            "--lateral-mm": [ranges["lateral_offset_mm"]],
            "--in-view": [ranges["in_view_min"]],
            "--point": craniotomy["centre_world_mm"],
            "--normal": craniotomy["outward_axis"],
        }
        # In full and without exponents, which argparse would take for options where they are negative.
        return [word for name, values in options.items() for word in (name, *map(_number, values))]

    def textures_folder(self, parameters) -> Path:
        return Path(parameters.texturesPath) if parameters.texturesPath else shipped_textures_folder()

    def texture_files(self, parameters) -> dict[str, tuple]:
        """Name -> (version, image path, labels path) of what lies in the folder now."""
        found = {}
        for name, (image, labels) in list_textures(self.textures_folder(parameters)).items():
            versions = [(str(p), p.stat().st_mtime_ns, p.stat().st_size) for p in (image, labels) if p]
            found[name] = ((name, *versions), image, labels)
        return found

    def changed_models(self, parameters) -> tuple[str, ...]:
        """Which of the chosen models are no longer those of the case."""
        case = self.case(parameters)
        if case is None:
            return ()
        changed = []
        for name, title in MODELS.items():
            of_case = getattr(case, name)
            try:
                chosen = self.mesh(parameters, name)
            except InputError:
                chosen = None
            version = (_Same(chosen), _Same(of_case))
            same = chosen is of_case or (
                chosen is not None
                and of_case is not None
                and self._once(f"same.{name}", version, lambda a=chosen, b=of_case: planning.same_mesh(a, b))
            )
            if not same:
                changed.append(title)
        return tuple(changed)

    def chosen(self, parameters, running: frozenset[str] = frozenset()) -> Chosen:
        camera, camera_problem, poses, poses_problem = None, "", None, ""
        try:
            camera = self.camera(parameters)
        except InputError as error:
            camera_problem = str(error)
        try:
            has_vessels = self.mesh(parameters, "vessels") is not None
            vessels_problem = ""
        except InputError as error:
            has_vessels, vessels_problem = False, str(error)
        if has_vessels and camera is not None:
            try:
                poses = self.pose_settings(parameters)
            except InputError as error:
                poses_problem = str(error)
        textures, textures_problem = self._textures(parameters)
        return Chosen(
            parameters.casePath,
            has_vessels,
            self.changed_models(parameters),
            camera,
            camera_problem,
            poses,
            poses_problem or vessels_problem,
            textures,
            textures_problem,
            {"size_px": parameters.sizePx, "iterations": parameters.iterations},
            parameters.preset.value,
            running,
            self.scan_to_keep(parameters) is not None,
            self.waiting(parameters),
            parameters.minutes,
        )

    def recorded(self, parameters) -> Recorded:
        p = parameters
        return self.reader.recorded(p.casePath, p.method.value, self.limits(p), p.casePath == p.savedCasePath)

    def steps(
        self, parameters, running: frozenset[str] = frozenset(), recorded: Recorded | None = None
    ) -> dict[str, Step]:
        return plan_steps(self.chosen(parameters, running), recorded or self.recorded(parameters))

    def prepare(self, parameters) -> Iterator[None]:
        """Work out what `steps` needs, a piece at each step; then `steps` answers at once. Changes nothing else."""
        case = self.case(parameters)
        yield
        for piece in (
            lambda: self.mesh(parameters, "vessels"),
            lambda: self.mesh(parameters, "cortex"),
            lambda: self._fitted_axis(*self._meshes(parameters), self.space(parameters)),
            lambda: self.craniotomy(parameters),
            lambda: self.sampler(parameters),
            lambda: case and case.vessels,
            lambda: case and case.cortex,
            lambda: self.changed_models(parameters),
            lambda: self.scan_to_keep(parameters),
            lambda: self.recorded(parameters),
        ):
            with contextlib.suppress(InputError):  # said by the step that it belongs to
                piece()
            yield

    def limits(self, parameters) -> Limits:
        p = parameters
        return Limits(p.acceptedAddLimitMm, p.acceptedRightLimitPercent / 100, p.acceptedLimitPercent / 100)

    def scan_to_keep(self, parameters) -> dict | None:
        """Identity of the chosen MRI where the saved case does not hold it yet; None where nothing is to be done."""
        case, node = self.case(parameters), parameters.mriVolume
        if case is None or node is None or not (node.GetImageData() and node.GetImageData().GetNumberOfPoints()):
            return None
        placed = tuple(mri.placement(node))
        version = (node.GetID(), node.GetImageData().GetMTime(), placed, _moved(node))
        identity = self._once("mri", version, lambda: mri.scan_identity(node))
        known = self._once(
            "mri.known", (version, case.folder, _Same(case.manifest)), lambda: mri.is_scan_of(case, identity)
        )
        return None if known else identity

    def problems_of_new_case(self, parameters, folder: str) -> list[str]:
        """Everything that keeps the chosen inputs from being saved as a case in `folder`, at once."""
        problems = Problems()
        if not folder:
            problems.add("Case folder: choose one with New.")
        if parameters.vesselsNode is None and self.case(parameters) is None:
            problems.add("Vessels: choose the model, or a segmentation and its segment.")
        for name in MODELS:
            with problems.collect():
                self.mesh(parameters, name)
        with problems.collect():
            self.camera(parameters)
        return problems.found

    def export_inputs(self, parameters, folder: Path) -> list[str]:
        """Write meshes and camera into `folder`; returns the options of the command `new`. Raises InputError."""
        folder.mkdir(parents=True, exist_ok=True)
        space = self.space(parameters)
        options = []
        for name in MODELS:
            mesh = self.mesh(parameters, name)
            if mesh is not None:
                write_plain_mesh(folder / f"{name}.vtk", mesh, space)
                options += [f"--{name}", str(folder / f"{name}.vtk")]
        write_camera(folder / "camera.json", self.camera(parameters))
        return [*options, "--camera", str(folder / "camera.json"), "--space", space]

    def _meshes(self, parameters) -> tuple[Mesh, Mesh | None]:
        vessels = self.mesh(parameters, "vessels")
        if vessels is None:
            raise InputError("Choose the vessel model first.")
        return vessels, self.mesh(parameters, "cortex")

    def _recorded_craniotomy(self, parameters) -> Craniotomy | None:
        case = self.case(parameters)
        values = case.manifest["stages"].get("render", {}).get("craniotomy") if case else None
        if not values:
            return None
        parts = [np.array(values[key], float) for key in ("centre_world_mm", "outward_axis", "up")]
        return self._once("recorded", str(values), lambda: Craniotomy(*parts))

    def is_fitted(self, parameters) -> bool:
        """Whether the craniotomy recorded in the case is the one that a fit gives; True where none is recorded."""
        recorded = self._recorded_craniotomy(parameters)
        if recorded is None:
            return True
        vessels, cortex = self._meshes(parameters)
        return not craniotomy_moved(vars(find_craniotomy(vessels, cortex, self.space(parameters))), vars(recorded))

    def _textures(self, parameters) -> tuple[dict[str, str], str]:
        folder = self.textures_folder(parameters)
        if not os.path.isdir(folder):
            return {}, f"{folder}: is no longer there; choose another folder."
        found = self.texture_files(parameters)
        bad = [self.texture_problems[version] for version, *_ in found.values() if version in self.texture_problems]
        bad = problems_of_folder(folder) + bad
        return {name: self.texture_digests.get(version, "") for name, (version, *_) in found.items()}, "\n".join(bad)

    def _once(self, name: str, version, make):
        """make(), again only where `version` changed; a failure is kept like a result."""
        kept = self._kept.get(name)
        if kept is None or kept[0] != version:
            try:
                kept = (version, make(), None)
            except InputError as error:
                kept = (version, None, error)
            self._kept[name] = kept
        if kept[2] is not None:
            raise kept[2]
        return kept[1]


def write_plain_mesh(path: Path, mesh: Mesh, space: str) -> None:
    """Legacy VTK file, binary and uncompressed: written in a few milliseconds. The header names the space."""
    from vtkmodules.vtkIOLegacy import vtkPolyDataWriter

    writer = vtkPolyDataWriter()
    writer.SetInputData(mesh.to_polydata())
    writer.SetHeader(f"SPACE={space}")
    writer.SetFileTypeToBinary()
    writer.SetFileName(str(path))
    if not writer.Write():
        raise InputError(f"{path}: cannot be written; free some space or choose a folder you may write to.")


def _version_of(node, segment_id: str = "") -> tuple:
    """Changes with the node's content and with the transforms above it."""
    moved = _moved(node)
    if node.IsA("vtkMRMLSegmentationNode"):
        return (segment_version(node, segment_id), moved)
    if node.IsA("vtkMRMLModelNode"):
        return (node.GetPolyData().GetMTime() if node.GetPolyData() else 0, moved)
    raise ValueError(f"{node.GetClassName()}: neither model nor segmentation")


def _moved(node) -> tuple:
    """Changes with the transforms above a node: with each of them, and with which ones they are."""
    parent = node.GetParentTransformNode()
    modified, above = parent.GetTransformToWorldMTime() if parent else 0, []
    while parent is not None:
        above.append(parent.GetID())
        parent = parent.GetParentTransformNode()
    # A transform that is taken out of the chain leaves the time as it was, where it was set before the others.
    return (modified, *above)


class _Same:
    """Equal to another of the very same object, which is kept alive: an id may be given to another one later."""

    def __init__(self, value):
        self.value = value

    def __eq__(self, other) -> bool:
        return isinstance(other, _Same) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


def _number(value) -> str:
    return str(value) if isinstance(value, int) else np.format_float_positional(value, trim="-")
