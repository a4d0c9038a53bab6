"""Compare predicted poses with known ones: metrics.json, curves, overlays and a report, in one folder."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .. import files
from ..case.case import Case
from ..errors import InputError, Problems
from ..geometry.camera import Camera, undistorted
from ..geometry.displacement import add_mm
from ..registration.footage import FRAME_MARK, is_there, read_frame_rgb
from ..registration.poses_file import Frame, check_vessels, read_poses, write_poses
from ..registration.record import frame_record
from .metrics import FrameErrors, frame_errors, mean_pose, metrics, reliability

ProgressFunction = Callable[[float, str], None]
NEEDED_MB = 50.0
OVERLAY_COUNT = 12
_SHOWN_SIDE_PX = 512  # overlays of small frames are drawn at about this size, so that outlines stay thin


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The pairs that were compared (same order) and what came out. camera is that of the frames."""

    camera: Camera
    true: list[Frame]
    predicted: list[Frame]
    errors: FrameErrors
    metrics: dict

    @property
    def styles(self) -> list[str | None]:
        return [frame.style for frame in self.true]


def evaluate(
    case: Case,
    poses_path: Path,
    out_folder: Path,
    styles: Sequence[str] | None = None,
    predicted_path: Path | None = None,
    progress: ProgressFunction = lambda _fraction, _message: None,
    predictor=None,
) -> Evaluation:
    """Register the frames of `poses_path`, whose poses are known, with the case's model, and write the comparison.

    styles: only frames of these. predicted_path: compare this poses file instead of running the model. predictor: used
    in place of the case's own. Writes metrics.json, predicted.json, curves.png, styles.png, overlays/*.png,
    overlays.png, report.html and, where confidences are known, reliability.png
    into out_folder. Raises InputError with all problems before anything is registered.
    """
    out_folder = Path(out_folder).absolute()
    problems = Problems()
    camera, true, predicted = case.camera, [], None
    with problems.collect():
        check_out(out_folder)
    with problems.collect():
        camera, true = known_frames(Path(poses_path), styles, case)
    if predicted_path is not None:
        with problems.collect():
            check_vessels(Path(predicted_path), case.vessels_sha256)
            predicted = _pair(true, Path(predicted_path))
    elif predictor is None:
        with problems.collect():
            from ..registration.predictor import open_predictor

            predictor = open_predictor(case)
    problems.raise_if_any()

    if predicted is None:
        predicted = register_frames(true, camera, predictor, progress)
    evaluation = compare(case, camera, true, predicted)
    _write(case, evaluation, out_folder, progress)
    return evaluation


def compare(case: Case, camera: Camera, true: list[Frame], predicted: list[Frame]) -> Evaluation:
    """Errors and metrics of paired frames, with the mean-pose baseline, and latency and reliability where known."""
    vertices_mm = case.vessels.vertices_mm
    true_poses = np.array([frame.camera_from_world for frame in true])
    poses, accepted = [frame.camera_from_world for frame in predicted], [frame.accepted for frame in predicted]
    errors = frame_errors(vertices_mm, true_poses, poses, accepted)
    result = metrics(errors, [frame.style for frame in true])
    baseline = np.broadcast_to(mean_pose(vertices_mm, true_poses), true_poses.shape)
    result["mean_pose_add_mm"] = float(add_mm(vertices_mm, true_poses, baseline).mean())
    # Of poses that another program wrote these may be anything.
    latency_ms = [ms for frame in predicted if isinstance(ms := frame.extra.get("latency_ms"), (int, float))]
    if latency_ms:
        median, p95 = np.percentile(latency_ms, (50, 95))
        result["latency_ms"] = {"median": float(median), "p95": float(p95)}
    confidence = [frame.extra.get("confidence") for frame in predicted]
    if all(isinstance(value, (int, float)) and 0 <= value <= 1 for value in confidence):
        result["reliability"] = reliability(confidence, errors)
    return Evaluation(camera, true, predicted, errors, result)


def check_out(folder: Path) -> None:
    """Raise InputError when `folder` cannot be made or written; makes nothing."""
    existing = files.existing_parent(folder.absolute() / "file")
    if existing.is_file():
        raise InputError(f"{existing}: is a file; give --out the name of a folder.")
    files.require_writable(folder)
    files.require_space(folder, NEEDED_MB)


def known_frames(path: Path, styles: Sequence[str] | None, case: Case) -> tuple[Camera, list[Frame]]:
    """Camera and frames of the wanted styles, all with a pose and an image. Raises InputError."""
    camera, frames = read_poses(path)
    problems = Problems()
    with problems.collect():
        check_vessels(path, case.vessels_sha256)
    if any("accepted" in frame.extra for frame in frames):
        problems.add(
            f"{path}: its poses were registered, and are not known to be right; give a file of known poses, and this "
            "one with --predicted."
        )
    if styles:
        known = {frame.style for frame in frames}
        listed = ", ".join(sorted(style for style in known if style is not None)) or "none"
        for style in sorted(set(styles) - known):
            problems.add(f"{path}: has no frames of style '{style}'; its styles are: {listed}.")
        frames = [frame for frame in frames if frame.style in styles]
    for frame in frames:
        if frame.camera_from_world is None:
            problems.add(f"{path}: {frame.image.name} has no camera_from_world; evaluation needs the known pose.")
        if not is_there(frame.image):
            problems.add(f"{frame.image}: image not found; {path.name} names it relative to its own folder.")
    problems.raise_if_any()
    return camera or case.camera, frames


def check_frame(frame: Frame, camera: Camera) -> None:
    """Raise InputError when the image of a frame cannot be read, or is none that the camera takes."""
    from ..registration.predictor import fitted_camera

    height, width = read_frame_rgb(frame.image).shape[:2]
    try:
        fitted_camera(camera, width, height)
    except InputError as error:
        raise InputError(f"{frame.image}: {error}") from error


def _pair(true: Iterable[Frame], path: Path) -> list[Frame]:
    """The frames of `path` with the images of `true`, in that order. Raises InputError naming those that lack."""
    by_image = {frame.image: frame for frame in read_poses(path)[1]}
    problems = Problems()
    for frame in true:
        if frame.image not in by_image:
            problems.add(f"{path}: has no frame for {frame.image}; register it too, or choose --styles.")
    problems.raise_if_any()
    return [by_image[frame.image] for frame in true]


def register_frames(true: list[Frame], camera: Camera, predictor, progress: ProgressFunction) -> list[Frame]:
    predicted, problems = [], Problems()
    for i, frame in enumerate(true):
        with problems.collect():
            image = read_frame_rgb(frame.image)
            try:
                prediction = predictor.predict(image, camera)
            except InputError as error:
                raise InputError(f"{frame.image}: {error}") from error
            record = frame_record(frame.image, prediction)
            extra = {key: value for key, value in record.items() if key not in ("image", "camera_from_world")}
            predicted.append(Frame(frame.image, prediction.camera_from_world, frame.style, extra))
        progress(0.8 * (i + 1) / len(true), f"Registering frames: {i + 1} of {len(true)}")
    problems.raise_if_any()
    return predicted


def _write(case: Case, evaluation: Evaluation, folder: Path, progress: ProgressFunction) -> None:
    from .curves import curve_points, write_curves, write_reliability, write_style_bars
    from .report import write_report

    errors, styles = evaluation.errors, evaluation.styles
    write_poses(folder / "predicted.json", evaluation.camera, _with_errors(evaluation), case.vessels_sha256)
    # A copy of the curves' points in numbers: a plot cannot be compared.
    files.write_json(folder / "metrics.json", evaluation.metrics | {"curves": curve_points(errors)})
    progress(0.85, "Drawing the curves")
    write_curves(folder / "curves.png", errors, styles)
    write_style_bars(folder / "styles.png", evaluation.metrics)
    if "reliability" in evaluation.metrics:
        write_reliability(folder / "reliability.png", {"": evaluation.metrics["reliability"]})
    progress(0.9, "Drawing the overlays")
    _write_overlays(case, evaluation, folder)
    write_report(folder, case.folder.name, evaluation)
    progress(1.0, f"Report: {folder / 'report.html'}")


def _with_errors(evaluation: Evaluation) -> list[dict]:
    """The predicted frames, with the style of the known ones and each frame's errors (None without a pose)."""
    entries = []
    for i, (true, frame) in enumerate(zip(evaluation.true, evaluation.predicted)):
        values = {name: getattr(evaluation.errors, name)[i] for name in ("add_mm", "rotation_deg", "translation_mm")}
        known = {name: None if np.isnan(value) else round(float(value), 4) for name, value in values.items()}
        style = {} if true.style is None else {"style": true.style}
        entries.append(frame.to_dict() | {"accepted": frame.accepted, "errors": known} | style)
    return entries


def _write_overlays(case: Case, evaluation: Evaluation, folder: Path) -> None:
    from .overlays import choose_frames, sheet

    chosen = choose_frames(evaluation.errors.add_mm, evaluation.styles, OVERLAY_COUNT)
    for old in (folder / "overlays").glob("[0-9][0-9]_*.png"):
        old.unlink()  # of an earlier run: they would pass for this one's
    tiles = []
    for rank, (index, tile) in enumerate(zip(chosen, overlay_images(case, evaluation, chosen))):
        style = f"{evaluation.true[index].style}_" if evaluation.true[index].style else ""
        # A style is any text of a poses.json: no path, and nothing that a disk may refuse at the end of the work.
        name = re.sub(r'[\\/:*?"<>|\x00-\x1f]', "_", f"{rank:02d}_{style}{_name(evaluation.true[index].image)}")
        name = name.encode("utf-8", "replace")[:200].decode("utf-8", "ignore")
        files.write_png(folder / "overlays" / f"{name}.png", tile)
        tiles.append(tile)
    files.write_png(folder / "overlays.png", sheet(tiles))


def overlay_images(case: Case, evaluation: Evaluation, indices: Iterable[int]) -> list[np.ndarray]:
    """uint8 RGB images with the true (green) and the predicted (blue) outline, captioned, for frames by index."""
    import cv2

    from ..masks.renderer import MaskRenderer
    from ..masks.stage import craniotomy_of, parenchyma_of
    from .overlays import draw_overlay, with_caption

    parenchyma = parenchyma_of(case, craniotomy_of(case))
    renderers: dict[Camera, MaskRenderer] = {}
    results = []
    indices = list(indices)
    images = {index: read_frame_rgb(evaluation.true[index].image) for index in sorted(indices)}  # as a video runs
    try:
        for index in indices:
            true, predicted, image = evaluation.true[index], evaluation.predicted[index], images[index]
            height, width = image.shape[:2]
            scale = max(1, round(_SHOWN_SIDE_PX / min(height, width)))
            image = undistorted(image, evaluation.camera.resized(width, height))
            image = cv2.resize(image, (width * scale, height * scale), interpolation=cv2.INTER_CUBIC)
            camera = evaluation.camera.resized(width * scale, height * scale)
            if camera not in renderers:
                renderers[camera] = MaskRenderer(case.vessels, parenchyma, camera)
            pose = predicted.camera_from_world
            labels = [None if p is None else renderers[camera].render(p) for p in (true.camera_from_world, pose)]
            results.append(with_caption(draw_overlay(image, *labels), _caption(evaluation, index)))
    finally:
        for renderer in renderers.values():
            renderer.close()
    return results


def _name(image: Path) -> str:
    """The file's without its suffix, which holds the number in VIDEO.avi#frame=N."""
    return f"{image.stem}{''.join(image.suffix.partition(FRAME_MARK)[1:])}"


def _caption(evaluation: Evaluation, index: int) -> str:
    true, predicted, errors = evaluation.true[index], evaluation.predicted[index], evaluation.errors
    name = f"{true.style}/{_name(true.image)}" if true.style else _name(true.image)
    if predicted.camera_from_world is None:
        return f"{name}: refused, no pose"
    refused = "" if predicted.accepted else " (refused)"
    return f"{name}: ADD {errors.add_mm[index]:.2f} mm, {errors.rotation_deg[index]:.1f} deg{refused}"
