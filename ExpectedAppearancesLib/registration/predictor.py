"""A frame's pose from the exported model, with onnxruntime alone."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from .. import files
from ..case.case import Case
from ..case.meshes import read_mesh
from ..errors import InputError
from ..geometry.camera import Camera
from .confidence import Confidence
from .contrast import SHARPER, ContrastAligner
from .covariance import CovarianceModel
from .decoding import PlausibleView, read_dense, read_regression
from .encoding import PoseEncoding, network_camera
from .refinement import VesselAligner

FORMAT_VERSION = 4  # 4: poses are sought farther off on the frame itself, and confidence was calibrated on that
EXPOSED_VESSELS_NAME = "exposed_vessels.vtp"


@dataclass(frozen=True)
class Prediction:
    """camera_from_world (4, 4), or None where no pose was found; accepted: whether it may be shown; confidence: the
    calibrated probability (0..1) that ADD < 3 mm; latency_ms: frame to pose; covariance (6, 6) of the error (rotation
    vector, rad; translation of the case's centre, mm) in the axes of the camera, as `covariance.py` defines it, or
    None without a pose or where the model tells none."""

    camera_from_world: np.ndarray | None
    accepted: bool
    confidence: float
    latency_ms: float
    covariance: np.ndarray | None = None


class Predictor:
    """Reads model_folder once; then one forward pass per frame. Raises InputError for a missing or damaged model."""

    def __init__(self, model_folder: Path, threads: int = 2):
        import onnxruntime

        folder = Path(model_folder)
        path = folder / "model.onnx"
        for part in (folder / "model.json", path):
            if not part.is_file():
                raise InputError(f"{part}: trained model missing; run `train` first.")
        meta = files.read_json(folder / "model.json", "trained model")
        version = meta.get("format_version") if isinstance(meta, dict) else None
        if version != FORMAT_VERSION:
            older = isinstance(version, int) and version < FORMAT_VERSION
            way_out = "an older version; train again" if older else "a newer version; update ExpectedAppearances"
            raise InputError(f"{folder / 'model.json'}: made by {way_out}.")
        if files.sha256(path) != meta.get("model_sha256"):
            raise InputError(
                f"{path}: damaged (SHA-256 differs from model.json); run `train` again, or restore the file."
            )
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.log_severity_level = 3
        # Between frames its threads would wait in a loop, and take the core that draws the frame.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        providers = [
            p for p in ("CUDAExecutionProvider", "CPUExecutionProvider") if p in onnxruntime.get_available_providers()
        ]
        self._session = onnxruntime.InferenceSession(str(path), options, providers=providers)
        self.meta = meta
        self.estimator = meta["estimator"]
        self.case_camera = Camera.from_dict(meta["camera"], str(folder / "model.json"))
        self.camera = network_camera(self.case_camera, meta["size_px"])
        self.encoding = PoseEncoding.from_dict(meta["encoding"])
        self.plausible = PlausibleView.from_dict(meta["plausible_view"])
        self.confidence = Confidence.from_dict(meta["confidence"])
        self.covariance = CovarianceModel.from_dict(meta.get("covariance"))
        if self.estimator == "dense":
            vessels = read_mesh(folder / EXPOSED_VESSELS_NAME, "vessels of the trained model")
            self.aligner = VesselAligner(vessels.vertices_mm, vessels.triangles, self.camera)
            sharp = network_camera(self.case_camera, SHARPER * meta["size_px"])
            self.contrast = ContrastAligner(vessels.vertices_mm, vessels.triangles, sharp)
        self._maps: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}

    @property
    def provider(self) -> str:
        """onnxruntime's name of what the model runs on in fact: it falls back to the CPU where no GPU can be used."""
        return self._session.get_providers()[0]

    @property
    def gives_covariance(self) -> bool:
        """False for a direct regression whose training calibrated none."""
        return self.estimator != "regression" or bool(self.covariance.shared.any())

    def predict(self, image_rgb: np.ndarray, camera: Camera | None = None) -> Prediction:
        """Pose of a frame uint8 (H, W, 3) taken by `camera` (the case's if None; A is scaled to the frame's size).

        Raises InputError when the camera's aspect ratio does not fit the frame.
        """
        begin = time.perf_counter()
        camera = fitted_camera(camera or self.case_camera, image_rgb.shape[1], image_rgb.shape[0])
        if self.estimator == "regression":
            seen = self._resample(image_rgb, camera, self.camera)
            reading = read_regression(self._output(seen), self.encoding)
        else:
            sharp = self._resample(image_rgb, camera, self.contrast.camera)
            seen = cv2.resize(sharp, (self.camera.width, self.camera.height), interpolation=cv2.INTER_AREA)
            output = self._output(seen)
            reading = read_dense(output, sharp, self.camera, self.encoding, self.aligner, self.contrast)
        confidence = self.confidence.probability(reading.evidence)
        pose = reading.camera_from_world
        accepted = pose is not None and confidence >= self.confidence.threshold and self.plausible.holds(pose)
        covariance = None
        if pose is not None:
            covariance = self.covariance.covariance(reading.fit, self.encoding.centre_world_mm)
        return Prediction(pose, bool(accepted), confidence, (time.perf_counter() - begin) * 1000, covariance)

    def _output(self, image_rgb: np.ndarray) -> np.ndarray:
        network_input = image_rgb.astype(np.float32).transpose(2, 0, 1)[None] / 255
        return self._session.run(None, {"image": network_input})[0][0]

    def _resample(self, image_rgb: np.ndarray, camera: Camera, wanted: Camera) -> np.ndarray:
        """The frame as the camera `wanted` would have taken it: undistorted, same centre of projection."""
        # Averaged down first, since remap mixes two by two pixels and would alias. By halves as far as they go:
        # averaging over fractions of pixels costs ten times as much, and above one half it gains nothing.
        while wanted.fx <= 0.5 * camera.fx and camera.width % 2 == camera.height % 2 == 0:
            camera = camera.resized(camera.width // 2, camera.height // 2)
            image_rgb = cv2.resize(image_rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        if wanted.fx < 0.5 * camera.fx:
            shrink = wanted.fx / camera.fx
            camera = camera.resized(*(max(1, round(side * shrink)) for side in (camera.width, camera.height)))
            image_rgb = cv2.resize(image_rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
        key = (camera, wanted)
        if key not in self._maps:
            distortion = np.array(camera.distortion) if camera.is_distorted else None
            size = (wanted.width, wanted.height)
            self._maps = {
                key: cv2.initUndistortRectifyMap(camera.matrix, distortion, None, wanted.matrix, size, cv2.CV_32FC1)
            }
        return cv2.remap(image_rgb, *self._maps[key], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)


def open_predictor(case: Case, threads: int = 2) -> Predictor:
    """The case's own. Raises InputError where its model is missing or damaged, or was trained on other vessels."""
    predictor = Predictor(case.model_folder, threads)
    trained_on = predictor.meta.get("vessels_sha256")
    if trained_on and trained_on != case.vessels_sha256:
        raise InputError(
            f"{case.model_folder}: this model was trained on the vessels of another case; train this case, or open "
            "the case that the model belongs to."
        )
    return predictor


def fitted_camera(camera: Camera, width: int, height: int) -> Camera:
    """A scaled to a frame of width x height px. Raises InputError when the frame has another aspect ratio."""
    if not camera.has_aspect_of(width, height):
        raise InputError(
            f"the frame is {width} x {height} px, the camera {camera.width} x {camera.height} px: another "
            "aspect ratio; give the intrinsics of these frames with --camera, or crop the frames as the camera was."
        )
    return camera if (width, height) == (camera.width, camera.height) else camera.resized(width, height)
