"""A case: one patient's meshes and camera, and all that is made from them, in one folder of open formats."""

from __future__ import annotations

import datetime
import os
import platform
import shutil
from collections.abc import Callable
from functools import cached_property
from importlib import metadata
from pathlib import Path

import numpy as np

from .. import files
from ..errors import InputError, Problems
from ..geometry.camera import Camera, read_camera, write_camera
from .meshes import Mesh, declared_space, read_mesh, write_vtp

FORMAT = "ExpectedAppearances case"
FORMAT_VERSION = 1
MANIFEST_NAME = "case.json"
SPACES = ("LPS", "RAS")
LARGEST_GAP_MM = 10.0  # between the boxes around vessels and cortex
FARTHEST_VIEW_MM = 3000.0  # from which the whole vessels should fill the view; microscopes work at 200-600 mm
NEEDED_MB = 20.0


class Case:
    """An existing case folder. Meshes are read on first use; `manifest` is case.json."""

    def __init__(self, folder: Path, manifest: dict, camera: Camera):
        self.folder = Path(folder)
        self.manifest = manifest
        self.camera = camera

    @property
    def space(self) -> str:
        """'LPS' or 'RAS': the axes of the world, which is the mesh files' coordinates."""
        return self.manifest["space"]

    @property
    def vessels_sha256(self) -> str:
        """Of the vessels' file: what tells one patient's poses and models from another's."""
        return self.manifest["inputs"]["vessels"]["sha256"]

    @cached_property
    def vessels(self) -> Mesh:
        return read_mesh(self.folder / self.manifest["inputs"]["vessels"]["file"], "vessel mesh")

    @cached_property
    def cortex(self) -> Mesh | None:
        entry = self.manifest["inputs"].get("cortex")
        return read_mesh(self.folder / entry["file"], "cortex mesh") if entry else None

    @property
    def poses_path(self) -> Path:
        return self.folder / "poses" / "poses.json"

    @property
    def masks_folder(self) -> Path:
        return self.folder / "masks"

    @property
    def appearances_folder(self) -> Path:
        return self.folder / "appearances"

    @property
    def model_folder(self) -> Path:
        return self.folder / "model"

    @staticmethod
    def create(
        folder: Path, vessels_path: Path, cortex_path: Path | None, camera_path: Path | Camera, space: str = "LPS"
    ) -> Case:
        """Make a case folder from a vessel mesh, a cortex mesh (or None) and a camera file (or a Camera).

        Everything is checked first; raises InputError with all problems. The folder appears whole or not at all.
        """
        folder = Path(folder).absolute()
        vessels, cortex, camera = Case.check_inputs(folder, vessels_path, cortex_path, camera_path, space)
        sources = {"vessels": vessels_path, "cortex": cortex_path}
        part = (
            folder / f".{os.getpid()}.part"
            if folder.is_dir()
            else folder.with_name(f".{folder.name}.{os.getpid()}.part")
        )
        shutil.rmtree(part, ignore_errors=True)  # of a killed run that had the same process id
        try:
            with files.writing(folder):
                part.mkdir(parents=True)
                inputs = {}
                for name, mesh in (("vessels", vessels), ("cortex", cortex)):
                    if mesh:
                        write_vtp(part / f"{name}.vtp", mesh, space)
                        inputs[name] = _input_entry(part / f"{name}.vtp", sources[name])
                write_camera(part / "camera.json", camera)
                inputs["camera"] = _input_entry(
                    part / "camera.json", None if isinstance(camera_path, Camera) else camera_path
                )
                manifest = {
                    "format": FORMAT,
                    "format_version": FORMAT_VERSION,
                    "created": _now(),
                    "versions": _versions(),
                    "space": space,
                    "inputs": inputs,
                    "stages": {},
                }
                files.write_json(part / MANIFEST_NAME, manifest)
                if part.parent == folder:  # it stays: a link, a disk's own folder, or where the user's shell stands
                    for made in sorted(part.iterdir(), key=lambda path: path.name == MANIFEST_NAME):
                        os.replace(made, folder / made.name)  # the manifest last, which makes it a case
                else:
                    os.replace(part, folder)
        except InputError as error:
            raise InputError(problem.replace(str(part), str(folder)) for problem in error.problems) from error
        finally:
            shutil.rmtree(part, ignore_errors=True)
        return Case(folder, manifest, camera)

    @staticmethod
    def check_inputs(
        folder: Path, vessels_path: Path, cortex_path: Path | None, camera_path: Path | Camera | None, space: str
    ) -> tuple[Mesh, Mesh | None, Camera | None]:
        """What `create` checks before it writes anything. Raises InputError with all problems."""
        problems = Problems()
        _check_new_folder(Path(folder).absolute(), problems)
        if space not in SPACES:
            problems.add(f"space: '{space}' is not known; give LPS (most files, and 3D Slicer's) or RAS.")
        camera = vessels = cortex = None
        with problems.collect():
            vessels = read_mesh(vessels_path, "vessel mesh")
        with problems.collect():
            cortex = read_mesh(cortex_path, "cortex mesh") if cortex_path else None
        with problems.collect():
            if isinstance(camera_path, Camera):
                camera = Camera.from_dict(camera_path.to_dict())
            elif camera_path is not None:
                camera = read_camera(camera_path)
        for source in filter(None, (vessels_path, cortex_path)):
            declared = declared_space(source)
            if declared and declared != space:
                problems.add(f"{source}: says that its space is {declared}, not {space}; give --space {declared}.")
        if vessels and camera:
            _check_view(vessels, camera, vessels_path, problems)
        if vessels and cortex:
            _check_distance(vessels, cortex, vessels_path, cortex_path, problems)
        problems.raise_if_any()
        return vessels, cortex, camera

    @staticmethod
    def open(folder: Path, sha256: Callable[[Path], str] = files.sha256) -> Case:
        """Open a case folder and check its inputs against the manifest. Raises InputError with all problems.

        sha256: of a file, for who opens the case again and again and knows which files have changed.
        """
        folder = Path(folder).absolute()
        path = folder / MANIFEST_NAME
        if not os.path.isfile(path):
            raise InputError(f"{folder}: not a case folder (no {MANIFEST_NAME} in it); make one with `new`.")
        files.require_text(folder)
        manifest = _read_manifest(path)
        problems = Problems()
        for name, entry in manifest["inputs"].items():
            file = folder / entry["file"]
            if not os.path.isfile(file):
                problems.add(f"{file}: {name} of the case is missing; restore it or make a new case.")
                continue
            with problems.collect(), files.reading(file):
                if sha256(file) != entry["sha256"]:
                    problems.add(
                        f"{file}: {name} is not the file the case was made with (SHA-256 differs); "
                        "restore it, or make a new case, since all stages rest on it."
                    )
        problems.raise_if_any()
        return Case(folder, manifest, read_camera(folder / manifest["inputs"]["camera"]["file"]))

    def record(self, stage: str, **values) -> None:
        """Merge `values` into manifest["stages"][stage] (with versions and time) and write case.json."""
        path = self.folder / MANIFEST_NAME
        self.manifest = _read_manifest(path)  # another process may have recorded a stage meanwhile
        entry = self.manifest["stages"].setdefault(stage, {})
        entry.update({"updated": _now(), "versions": _versions()} | values)
        files.write_json(path, self.manifest)

    def attach(self, name: str, entry: dict) -> None:
        """Note a file that lies in the case and that no stage depends on, in manifest["attachments"][name]."""
        path = self.folder / MANIFEST_NAME
        self.manifest = _read_manifest(path)
        self.manifest.setdefault("attachments", {})[name] = entry
        files.write_json(path, self.manifest)


def pose_settings(manifest: dict) -> dict:
    """'ranges' and 'craniotomy' as `render` recorded them last, None where it has not: training, too, draws poses in
    these ranges around the craniotomy."""
    render = manifest["stages"].get("render", {})
    return {key: render.get(key) for key in ("ranges", "craniotomy")}


def _check_new_folder(folder: Path, problems: Problems) -> None:
    with problems.collect():
        files.require_text(folder)
    if folder.is_file():
        problems.add(f"{folder}: is a file; give the name of a new folder.")
        return
    # Of a run that was killed a hidden folder may be left.
    if folder.is_dir() and any(not path.match(".*.part") for path in folder.iterdir()):
        problems.add(f"{folder}: exists and is not empty; give a new folder, or remove this one first.")
    with problems.collect():
        files.require_writable(folder)
        files.require_space(folder, NEEDED_MB)


def _check_view(vessels: Mesh, camera: Camera, vessels_path: Path, problems: Problems) -> None:
    # field_of_view_mm is linear in depth: the depth at which the view is as wide as the vessels.
    filled_at_mm = 2 * vessels.radius_mm / camera.field_of_view_mm(1.0)
    if filled_at_mm > FARTHEST_VIEW_MM:
        problems.add(
            f"{vessels_path}: the vessels ({2 * vessels.radius_mm:.0f} mm across) could never be in view: the camera "
            f"sees {camera.field_of_view_mm(300.0):.1f} mm at 300 mm; "
            "cut the mesh to the craniotomy, or check the camera."
        )


def _check_distance(vessels: Mesh, cortex: Mesh, vessels_path: Path, cortex_path: Path, problems: Problems) -> None:
    gap_mm = _gap_mm(vessels.vertices_mm, cortex.vertices_mm)
    if gap_mm <= LARGEST_GAP_MM:
        return
    flipped_gap_mm = _gap_mm(vessels.vertices_mm, cortex.vertices_mm * (-1.0, -1.0, 1.0))
    cause = (
        "one looks like LPS and the other like RAS, save both in the same space"
        if flipped_gap_mm <= LARGEST_GAP_MM
        else "give meshes of the same patient in the same space"
    )
    problems.add(f"{cortex_path}: the cortex lies {gap_mm:.0f} mm from the vessels ({vessels_path}); {cause}.")


def _gap_mm(first_mm: np.ndarray, second_mm: np.ndarray) -> float:
    """Distance between the axis-aligned boxes around two sets of points."""
    apart = np.maximum(first_mm.min(0) - second_mm.max(0), second_mm.min(0) - first_mm.max(0))
    return float(np.linalg.norm(np.maximum(apart, 0.0)))


def _input_entry(path: Path, source: Path | None) -> dict:
    entry = {"file": path.name, "source": Path(source).absolute().as_posix() if source else None}
    return entry | {"sha256": files.sha256(path)}


def _read_manifest(path: Path) -> dict:
    manifest = files.read_json(path, "case manifest")
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(f"{path}: not the manifest of a case; make a case with `new`.")
    version = manifest.get("format_version")
    if not isinstance(version, int) or version > FORMAT_VERSION:
        raise InputError(
            f"{path}: case of format version {version}, newer than {FORMAT_VERSION}, the newest known here; "
            "update ExpectedAppearances, or make the case again."
        )
    inputs = manifest.get("inputs")
    whole = isinstance(inputs, dict) and {"vessels", "camera"} <= inputs.keys() and manifest.get("space") in SPACES
    whole = whole and all(isinstance(e, dict) and {"file", "sha256"} <= e.keys() for e in inputs.values())
    if not whole or not isinstance(manifest.get("stages"), dict):
        raise InputError(f"{path}: case manifest lacks its space, inputs or stages; restore it or make a new case.")
    return manifest


def _now() -> str:
    return datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")


def _versions() -> dict:
    """Versions of what a case's content depends on, where installed."""
    versions = {"python": platform.python_version()}
    for package in ("expected-appearances", "numpy", "vtk", "torch", "onnxruntime", "opencv-python-headless"):
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return versions
