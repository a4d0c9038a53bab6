"""A phantom: the generated patient painted so that each colour tells its own place, with a model that reads it off.

It stands in for a trained case where none is at hand: everything from frame to pose is the real code, onnxruntime
included, and the true poses are known. It says nothing about accuracy on real frames, which have no such colours.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import files
from ..case.case import Case
from ..case.meshes import Mesh, write_vtp
from ..geometry.camera import Camera
from ..geometry.pose import apply_to_vtk_camera, look_at, transform
from ..masks.exposed import exposed_vessels
from ..poses.craniotomy import find_craniotomy
from ..registration.confidence import Confidence
from ..registration.covariance import CovarianceModel
from ..registration.decoding import EVIDENCE
from ..registration.encoding import PoseEncoding
from ..registration.predictor import EXPOSED_VESSELS_NAME, FORMAT_VERSION
from .vessel_tree import generate_case_meshes

NETWORK = Path(__file__).with_name("phantom.onnx")
MIDDLE, GAIN = 0.55, 0.33  # colour = MIDDLE + GAIN x coordinate / scale, 0..1
VESSEL_RGB = (0.42, 0.0, 0.05)  # green 0: the network takes no point from vessels
BACKGROUND_RGB = (0.0, 0.0, 0.0)
SIZE_PX = 128
ERROR_RAD, ERROR_MM = 0.002, 0.05  # twice what its poses err by, root mean square
CLOSENESS = 0.67  # of the distance from which all vessels fit into the view
CAMERA = Camera(640, 480, 1900.0, 1900.0, 331.0, 226.0)
SAMPLE_FRAMES = 90
COVERED = range(50, 62)  # of the sample's frames: a hand is in the way


def network_bytes() -> bytes:
    """The network as ONNX: image (1, 3, S, S) -> output (1, 6, S/2, S/2) as a dense model gives it. Needs `onnx`.

    Coordinates are the mean colour of each 2 x 2 px; a cell counts as surface when all around it is painted.
    """
    from onnx import TensorProto, checker, helper

    def constant(name: str, values) -> object:
        array = np.asarray(values, np.float32)
        return helper.make_tensor(name, TensorProto.FLOAT, array.shape, array.ravel())

    nodes = [
        helper.make_node("AveragePool", ["image"], ["mean"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Sub", ["mean", "middle"], ["offset"]),
        helper.make_node("Div", ["offset", "gain"], ["coordinates"]),
        helper.make_node("Neg", ["image"], ["negative"]),
        helper.make_node("MaxPool", ["negative"], ["pooled"], kernel_shape=[6, 6], strides=[2, 2], pads=[2, 2, 2, 2]),
        helper.make_node("ReduceMax", ["pooled"], ["darkest"], axes=[1], keepdims=1),
        helper.make_node("Add", ["darkest", "threshold"], ["dark"]),
        helper.make_node("Mul", ["dark", "steep"], ["surface"]),
        helper.make_node("Mul", ["surface", "zero"], ["zeros"]),
        helper.make_node("Add", ["zeros", "log_sigma"], ["sigma"]),
        helper.make_node("Sub", ["zeros", "one"], ["vessel"]),
        helper.make_node("Concat", ["coordinates", "sigma", "surface", "vessel"], ["output"], axis=1),
    ]
    constants = {"middle": MIDDLE, "gain": GAIN, "threshold": 0.08, "steep": -100.0, "zero": 0.0}
    constants |= {"log_sigma": np.log(0.01), "one": 1.0}
    half = SIZE_PX // 2
    graph = helper.make_graph(
        nodes,
        "phantom",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, SIZE_PX, SIZE_PX])],
        [helper.make_tensor_value_info("output", TensorProto.FLOAT, [1, 6, half, half])],
        [constant(name, value) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    checker.check_model(model)
    return model.SerializeToString()


@dataclass(frozen=True, eq=False)
class Phantom:
    """The case with its model, and how its colours are made."""

    case: Case
    encoding: PoseEncoding

    def pose(self, phase: float) -> np.ndarray:
        """camera_from_world on a closed path over the craniotomy, phase 0..1; never twice the same view."""
        craniotomy = find_craniotomy(self.case.vessels, self.case.cortex, self.case.space)
        distance_mm = _distance_mm(self.case)
        across = np.cross(craniotomy.up, craniotomy.outward_axis)
        angle = 2 * np.pi * phase
        tilt = 0.30 + 0.12 * np.sin(3 * angle)
        away = np.cos(tilt) * craniotomy.outward_axis
        away = away + np.sin(tilt) * (np.cos(angle) * across + np.sin(angle) * craniotomy.up)
        target = craniotomy.centre_world_mm + 3.0 * np.sin(2 * angle) * across + 2.0 * np.cos(angle) * craniotomy.up
        centre = target + away * distance_mm * (1 + 0.08 * np.sin(2 * angle + 1))
        return look_at(centre, target, craniotomy.up + 0.4 * np.sin(angle) * across)


def make_phantom(folder: Path, seed: int = 0) -> Phantom:
    """Write the generated patient as a case with the phantom's model into `folder`, or open it where it is whole."""
    folder = Path(folder)
    if not (folder / "model" / "model.json").is_file():
        shutil.rmtree(folder, ignore_errors=True)
        vessels, cortex = generate_case_meshes(seed)
        parts = folder.with_name(folder.name + ".inputs")
        try:
            write_vtp(parts / "vessels.vtp", vessels)
            write_vtp(parts / "cortex.vtp", cortex)
            case = Case.create(folder, parts / "vessels.vtp", parts / "cortex.vtp", CAMERA)
        finally:
            shutil.rmtree(parts, ignore_errors=True)
        return as_phantom(case)
    case = Case.open(folder)
    model = files.read_json(folder / "model" / "model.json", "phantom's model")
    if model.get("format_version") != FORMAT_VERSION:  # kept since before an update, and nobody can train it again
        return as_phantom(case)
    return Phantom(case, _encoding(case))


def as_phantom(case: Case) -> Phantom:
    """Give a case with a cortex the phantom's model."""
    _write_model(case)
    return Phantom(case, _encoding(case))


def write_sample_frames(phantom: Phantom, folder: Path, count: int = SAMPLE_FRAMES) -> Path:
    """Paint `count` frames along the path into folder/NNN.png with their true poses; returns poses.json.

    During COVERED something is in the way, so that refusal can be seen too; those frames have no pose.
    """
    from ..registration.poses_file import write_poses

    path = Path(folder) / "poses.json"
    if path.is_file():
        return path
    entries = []
    with PhantomPainter(phantom) as painter:
        for number in range(count):
            pose = phantom.pose(number / count)
            image = Path(folder) / f"{number:03d}.png"
            covered = number in COVERED
            files.write_png(image, covered_frame(number) if covered else painter.paint(pose))
            entries.append({"image": image, "camera_from_world": None if covered else pose})
    write_poses(path, CAMERA, entries)
    return path


def covered_frame(number: int, camera: Camera = CAMERA) -> np.ndarray:
    """A frame with no cortex in it, only blurred skin-coloured noise: uint8 RGB."""
    import cv2

    noise = np.random.default_rng(number).normal(0, 1, (camera.height // 8, camera.width // 8))
    noise = cv2.resize(cv2.GaussianBlur(noise, None, 2.0), (camera.width, camera.height), interpolation=cv2.INTER_CUBIC)
    return np.clip((np.array([0.75, 0.55, 0.45]) * (1 + 0.6 * noise[..., None])) * 255, 30, 255).astype(np.uint8)


class PhantomPainter:
    """Draws frames of the phantom off-screen for `camera`. Close it, or use it as a context manager."""

    def __init__(self, phantom: Phantom, camera: Camera | None = None):
        import vtk

        from ..masks.renderer import offscreen_window

        camera = self._camera = (camera or phantom.case.camera).without_distortion()
        self._case = phantom.case
        self._pixels = vtk.vtkUnsignedCharArray()
        self._window = offscreen_window(camera.width, camera.height)
        self._renderer = vtk.vtkRenderer()
        self._renderer.SetBackground(*BACKGROUND_RGB)
        self._window.AddRenderer(self._renderer)
        cortex, vessels = phantom.case.cortex, phantom.case.vessels
        code = (cortex.vertices_mm - phantom.encoding.centre_world_mm) / phantom.encoding.scale_mm
        self._add(cortex, np.clip(MIDDLE + GAIN * code, 0, 1))
        self._add(vessels, np.tile(VESSEL_RGB, (len(vessels.vertices_mm), 1)))

    def paint(self, camera_from_world: np.ndarray) -> np.ndarray:
        """uint8 RGB (H, W, 3) from the pose."""
        from vtk.util.numpy_support import vtk_to_numpy

        camera = self._camera
        depth_mm = transform(camera_from_world, self._case.vessels.centroid_mm[None])[0, 2]
        reach_mm = 3 * self._case.vessels.radius_mm
        near, far = max(depth_mm - reach_mm, 1.0), depth_mm + reach_mm
        apply_to_vtk_camera(self._renderer.GetActiveCamera(), camera, camera_from_world, near, far)
        self._window.Render()
        self._window.GetPixelData(0, 0, camera.width - 1, camera.height - 1, 0, self._pixels, 0)
        return vtk_to_numpy(self._pixels).reshape(camera.height, camera.width, 3)[::-1].copy()

    def close(self) -> None:
        self._window.Finalize()

    def __enter__(self) -> PhantomPainter:
        return self

    def __exit__(self, *_exception) -> None:
        self.close()

    def _add(self, mesh: Mesh, colours: np.ndarray) -> None:
        import vtk
        from vtk.util.numpy_support import numpy_to_vtk

        polydata = mesh.to_polydata()
        scalars = numpy_to_vtk(np.rint(colours * 255).astype(np.uint8), deep=True)
        polydata.GetPointData().SetScalars(scalars)
        mapper = vtk.vtkPolyDataMapper()
        mapper.SetInputData(polydata)
        actor = vtk.vtkActor()
        actor.SetMapper(mapper)
        actor.GetProperty().LightingOff()
        self._renderer.AddActor(actor)


def _distance_mm(case: Case) -> float:
    return CLOSENESS * 2 * case.vessels.radius_mm / case.camera.field_of_view_mm(1.0)


def _encoding(case: Case) -> PoseEncoding:
    centre, scale = case.vessels.centroid_mm, case.vessels.radius_mm
    return PoseEncoding(np.eye(3), centre, scale, np.array([0.0, 0.0, _distance_mm(case)]), scale)


def _write_model(case: Case) -> None:
    """model.onnx and model.json as training writes them; confident where the points agree with one view."""
    craniotomy = find_craniotomy(case.vessels, case.cortex, case.space)
    count = EVIDENCE["dense"]
    weights = np.zeros(count)
    weights[2] = -1.5  # log of the share of outliers
    confidence = Confidence(np.zeros(count), np.ones(count), weights, -2.5, 0.8)
    files.write_bytes(case.model_folder / "model.onnx", NETWORK.read_bytes())
    meta = {
        "format_version": FORMAT_VERSION,
        "model_sha256": files.sha256(case.model_folder / "model.onnx"),
        "estimator": "dense",
        "preset": "phantom",
        "size_px": SIZE_PX,
        "camera": case.camera.to_dict(),
        "encoding": _encoding(case).to_dict(),
        "plausible_view": {
            "centre_world_mm": case.vessels.centroid_mm.tolist(),
            "outward_axis": craniotomy.outward_axis.tolist(),
            "tilt_max_deg": 60.0,
            "distance_mm": [0.6 * _distance_mm(case), 1.6 * _distance_mm(case)],
        },
        "confidence": confidence.to_dict(),
        "covariance": CovarianceModel(np.diag(np.repeat([ERROR_RAD, ERROR_MM], 3) ** 2), 0.0).to_dict(),
        "vessels_sha256": case.vessels_sha256,
    }
    exposed = exposed_vessels(case.vessels, case.cortex, craniotomy.outward_axis)
    write_vtp(case.model_folder / EXPOSED_VESSELS_NAME, exposed)
    files.write_json(case.model_folder / "model.json", meta)
