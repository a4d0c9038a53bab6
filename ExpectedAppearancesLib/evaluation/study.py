"""The paper's results section on a case: leave-one-texture-out, number of textures, robustness; CASE/study/study.json.

Each left-out texture is tested by a model that was trained on the others:
strict: every training view has a pose of its own, so texture and pose of a test frame are both new to the model;
loto: the paper's form. The texture is new, the poses are not: training views repeat the poses of the test frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from .. import files
from ..errors import InputError
from ..executor import run_jobs
from ..model.presets import PRESETS
from ..registration.poses_file import Frame, read_poses, write_poses
from ..registration.predictor import FORMAT_VERSION as MODEL_VERSION
from .curves import curve_points
from .evaluate import Evaluation, compare, overlay_images, register_frames
from .metrics import add_auc, nearest_other_pose_add_mm
from .overlays import choose_frames, sheet
from .study_folds import SPACE_MB, FoldJob, is_trained, train_fold
from .study_inputs import LEFT_OUT, TEXTURE_COUNTS, ProgressFunction, StudyCase, StudySettings, check_study
from .verdict import STUDY_FORMAT

FORMAT_VERSION = 1
CURVE_STEP = 0.25  # mm and degrees between the points of the curves
TRAINING_SHARE = 0.85  # of the progress


def run_study(
    pairs: Sequence[tuple[Path, Path | None]],
    out_folder: Path,
    settings: StudySettings,
    progress: ProgressFunction = lambda _fraction, _message: None,
) -> list[dict]:
    """Study each (case folder, poses file with known poses); returns the content of each CASE/study/study.json.

    Without a poses file the test frames are drawn from the case's own appearances, see study_frames.
    Writes study.json into each case and report.html with its figures into out_folder. Killed, it goes on: a finished
    fold is not trained again. Raises InputError with all problems before anything is trained.
    """
    from .study_report import write_study_report

    out_folder = Path(out_folder).absolute()
    studied = check_study(pairs, out_folder, settings, progress)
    jobs = [job for one in studied for job in _jobs(one, settings)]
    waiting = [job for job in jobs if not is_trained(job)]
    for one in studied:
        count = sum(job.case_folder == str(one.case.folder) for job in waiting)
        files.require_space(one.folder, count * SPACE_MB["fold"] + SPACE_MB["under way"])
    progress(0.0, f"{len(waiting)} of {len(jobs)} models are to be trained")
    run_jobs(waiting, train_fold, settings.executor, lambda f, text: progress(TRAINING_SHARE * f, text))

    results = []
    for i, one in enumerate(studied):
        begin, share = TRAINING_SHARE + (1 - TRAINING_SHARE) * i / len(studied), (1 - TRAINING_SHARE) / len(studied)
        results.append(_evaluate(one, settings, lambda f, text, b=begin, s=share: progress(b + s * f, text)))
    write_study_report(out_folder, [(one.case.folder, result) for one, result in zip(studied, results)])
    progress(1.0, f"Report: {out_folder / 'report.html'}")
    return results


def study_path(case_folder: Path) -> Path:
    return Path(case_folder) / "study" / "study.json"


def read_study(case_folder: Path) -> dict | None:
    """The content of a case's study.json, None where no study was made. Raises InputError when it is none."""
    path = study_path(case_folder)
    if not path.is_file():
        return None
    values = files.read_json(path, "study")
    if (
        not isinstance(values, dict)
        or values.get("format") != STUDY_FORMAT
        or not isinstance(values.get("presets"), dict)
    ):
        raise InputError(f"{path}: not the result of a study; run `study` again.")
    if not isinstance(values.get("format_version"), int) or values["format_version"] > FORMAT_VERSION:
        raise InputError(f"{path}: made by a newer version; update ExpectedAppearances, or run `study` again.")
    return values


def _jobs(one: StudyCase, settings: StudySettings) -> list[FoldJob]:
    jobs = [
        _job(one, settings, preset, protocol, style, (style,))
        for preset in settings.presets
        for protocol in settings.protocols
        for style in one.styles
    ]
    if settings.textures_study:
        for trained_on in texture_subsets(one.textures, one.with_frames, settings.seed)[1]:
            exclude = tuple(style for style in one.textures if style not in trained_on)
            jobs.append(_job(one, settings, settings.presets[0], "textures", f"{len(trained_on):02d}", exclude))
    return jobs


def _job(one: StudyCase, settings: StudySettings, preset: str, protocol: str, name: str, exclude) -> FoldJob:
    given = {key: getattr(settings, key) for key in ("steps", "minutes") if getattr(settings, key) is not None}
    tested_on = {"frames_sha256"} | ({"poses_sha256"} if protocol != "loto" else set())
    inputs = {key: value for key, value in one.inputs.items() if key not in tested_on}
    identity = {"preset": replace(PRESETS[preset], **given).to_dict(), "seed": settings.seed, "protocol": protocol}
    # A model of an older version cannot be read any more.
    identity |= {"exclude": list(exclude), "method": one.method, "inputs": inputs, "model_version": MODEL_VERSION}
    return FoldJob(
        case_folder=str(one.case.folder),
        name=f"{preset}-{protocol}-{name}",
        protocol=protocol,
        preset=preset,
        exclude=tuple(exclude),
        poses_path=str(one.poses_path),
        seed=settings.seed,
        device=settings.device,
        method=one.method,
        steps=settings.steps,
        minutes=settings.minutes,
        settings=identity,
    )


def texture_subsets(textures: Sequence[str], tested: Sequence[str], seed: int) -> tuple[list[str], list[list[str]]]:
    """Three of the `tested` textures, left out of all models, and the textures of each model: 3, 4 ... of the others.

    Each set holds the one before, so that models differ in nothing but the textures that were added.
    """
    rng = np.random.default_rng([seed, 23])
    left_out = sorted(rng.permutation(sorted(tested)).tolist()[:LEFT_OUT])
    others = rng.permutation(sorted(set(textures) - set(left_out))).tolist()
    return left_out, [sorted(others[:n]) for n in TEXTURE_COUNTS if n <= len(others)]


def _evaluate(one: StudyCase, settings: StudySettings, progress: ProgressFunction) -> dict:
    """Fill the case's study.json, part by part, and return it."""
    study = _begin(one, settings)
    parts = [(preset, protocol) for preset in settings.presets for protocol in settings.protocols]
    for i, (preset, protocol) in enumerate(parts):
        progress(0.7 * i / len(parts), f"registering frames with the models of {preset}, {protocol}")
        folds = {style: _job(one, settings, preset, protocol, style, (style,)) for style in one.styles}
        evaluation = _of_folds(one, {style: (job, [style]) for style, job in folds.items()})
        shown = _write_overlays(one, evaluation, f"{preset}-{protocol}") if preset == settings.presets[0] else None
        entry = _figures(evaluation) | {"folds": {style: _training(job) for style, job in folds.items()}}
        study["presets"].setdefault(preset, {})[protocol] = entry | ({"overlays": shown} if shown else {})
        _save(one, study, settings)
    if settings.textures_study:
        progress(0.7, "registering frames with the models of the number-of-textures study")
        study["textures"] = _textures_study(one, settings)
        _save(one, study, settings)
    if settings.robustness:
        study["robustness"] = _robustness(one, settings, lambda f, text: progress(0.75 + 0.25 * f, text))
        _save(one, study, settings)
    return study


def _begin(one: StudyCase, settings: StudySettings) -> dict:
    """The study so far where it is about the same inputs, else a new one."""
    try:
        before = read_study(one.case.folder)
    except InputError:
        before = None
    if before and before.get("inputs") == one.inputs:
        own = _own_model_sha256(one)
        if before.get("robustness", {}).get("own_model_sha256", own) != own:
            del before["robustness"]  # of the case's own model, which has been trained again since
        return before
    study = {
        "format": STUDY_FORMAT,
        "format_version": FORMAT_VERSION,
        "case": one.case.folder.name,
        "inputs": one.inputs,
    }
    distances = nearest_other_pose_add_mm(one.case.vessels.vertices_mm, [f.camera_from_world for f in one.frames])
    study["nearest_other_pose_add_mm"] = float(np.mean(distances)) if len(distances) else None
    return study | {"presets": {}, "preset": settings.presets[0], "protocols": {}, "thresholds": {}}


def _save(one: StudyCase, study: dict, settings: StudySettings) -> None:
    """The first preset's figures also stand on top: they are what a panel shows."""
    if settings.presets[0] in study["presets"]:
        study["preset"] = settings.presets[0]
        protocols = study["presets"][study["preset"]]
        study["protocols"] = {name: {k: entry[k] for k in ("per_style", "all")} for name, entry in protocols.items()}
        study["thresholds"] = {name: entry["thresholds"] for name, entry in protocols.items()}
    study["settings"] = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(settings).items()}
    files.write_json(study_path(one.case.folder), study)


def _of_folds(one: StudyCase, folds: dict[str, tuple[FoldJob, list[str]]]) -> Evaluation:
    """All frames of the styles, each registered by the model of its fold."""
    true, predicted = [], []
    for job, styles in folds.values():
        frames = [frame for frame in one.frames if frame.style in styles]
        true += frames
        predicted += _registered(one, job, frames)
    return compare(one.case, one.camera, true, predicted)


def _registered(one: StudyCase, job: FoldJob, frames: list[Frame]) -> list[Frame]:
    """Frames as the fold's model sees them; what was registered before with the same model is read again."""
    path, made_of = job.folder / "predicted.json", job.folder / "predicted.of.json"
    of = {"model_sha256": files.sha256(job.folder / "model.onnx"), "camera": one.camera.to_dict()}
    of |= {key: one.inputs[key] for key in ("poses_sha256", "frames_sha256")}
    if path.is_file() and made_of.is_file() and files.read_json(made_of, "record of predictions") == of:
        by_image = {frame.image: frame for frame in read_poses(path)[1]}
        if all(frame.image in by_image for frame in frames):
            return [by_image[frame.image] for frame in frames]
    from ..registration.predictor import Predictor

    predicted = register_frames(frames, one.camera, Predictor(job.folder), lambda *_: None)
    write_poses(path, one.camera, [frame.to_dict() for frame in predicted])
    files.write_json(made_of, of)
    return predicted


def _figures(evaluation: Evaluation) -> dict:
    figures = dict(evaluation.metrics)
    per_style = figures.pop("styles")
    curve = curve_points(evaluation.errors, CURVE_STEP) | {"add_auc_20mm": add_auc(evaluation.errors)}
    return {"per_style": per_style, "all": figures, "thresholds": curve}


def _training(job: FoldJob) -> dict:
    """Steps, time and inner validation of a fold's training."""
    values = files.read_json(job.folder / "training.json", "record of a training")["validation"]
    return {key: values[key] for key in ("steps", "seconds", "add_mm_mean")}


def _textures_study(one: StudyCase, settings: StudySettings) -> dict:
    left_out, subsets = texture_subsets(one.textures, one.with_frames, settings.seed)
    rows = []
    for trained_on in subsets:
        exclude = tuple(style for style in one.textures if style not in trained_on)
        job = _job(one, settings, settings.presets[0], "textures", f"{len(trained_on):02d}", exclude)
        evaluation = _of_folds(one, {"": (job, left_out)})
        row = {"textures": len(trained_on), "trained_on": trained_on, "training": _training(job)}
        rows.append(row | {"metrics": _figures(evaluation)["all"]})
    return {"preset": settings.presets[0], "left_out": left_out, "rows": rows}


def _robustness(one: StudyCase, settings: StudySettings, progress: ProgressFunction) -> dict:
    from .robustness import example_sheet, robustness_table

    vertices_mm, frames = one.case.vessels.vertices_mm, [frame for frame in one.frames if frame.style in one.styles]
    predictor_of, model = _predictor_of(one, settings)
    count, seed = settings.robustness_frames, settings.seed
    table = robustness_table(vertices_mm, one.camera, frames, predictor_of, model, count, seed, progress)
    files.write_png(one.folder / "robustness.png", example_sheet(frames[0], one.camera, vertices_mm, seed))
    return table | {"examples": "robustness.png", "own_model_sha256": _own_model_sha256(one)}


def _own_model_sha256(one: StudyCase) -> str | None:
    path = one.case.model_folder / "model.onnx"
    return files.sha256(path) if path.is_file() else None


def _predictor_of(one: StudyCase, settings: StudySettings):
    """(style -> predictor, which model that is): the case's own model, else those of the first preset's folds."""
    from ..registration.predictor import Predictor, open_predictor

    if (one.case.model_folder / "model.onnx").is_file():
        own = open_predictor(one.case)
        seen = len(set(one.styles) & set(own.meta.get("styles", ())))
        trained_on = f", which was trained on {seen} of their {len(one.styles)} textures" if seen else ""
        return (lambda _style: own), f"the case's own model ({own.meta['preset']}){trained_on}"
    preset, protocol = settings.presets[0], settings.protocols[0]
    folders = {style: _job(one, settings, preset, protocol, style, (style,)).folder for style in one.styles}
    predictors = {style: Predictor(folder) for style, folder in folders.items()}
    return predictors.__getitem__, f"models of {preset}, {protocol}, that have not seen the frame's texture"


def _write_overlays(one: StudyCase, evaluation: Evaluation, name: str) -> str:
    """Writes CASE/study/overlays-NAME.png; returns the file's name."""
    chosen = choose_frames(evaluation.errors.add_mm, evaluation.styles, 12)
    files.write_png(one.folder / f"overlays-{name}.png", sheet(overlay_images(one.case, evaluation, chosen)))
    return f"overlays-{name}.png"
