"""What a study is made of: its settings, and each case with its frames, all checked before anything is trained."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .. import files
from ..appearances.store import index_path, read_appearances
from ..case.case import Case, pose_settings
from ..errors import Problems
from ..executor import LOCAL, check_executor
from ..geometry.camera import Camera
from ..model.presets import PRESETS
from ..registration.poses_file import Frame
from .evaluate import check_frame, check_out, known_frames
from .study_folds import PROTOCOLS
from .study_frames import FRAMES_PER_TEXTURE, check_poses, digest_of, drawn_frames

LEFT_OUT = 3  # textures of the number-of-textures study that no model is trained on
TEXTURE_COUNTS = range(3, 13)
ProgressFunction = Callable[[float, str], None]


@dataclass(frozen=True)
class StudySettings:
    """What to do. styles: textures to leave out, None for all that have frames. steps, minutes: of each training; None
    for the preset's. method: of the appearances; None for the one that is complete. frames: of each texture, where they
    are drawn from the appearances."""

    protocols: tuple[str, ...] = PROTOCOLS
    presets: tuple[str, ...] = ("quick",)
    styles: tuple[str, ...] | None = None
    textures_study: bool = False
    robustness: bool = False
    robustness_frames: int = 80
    steps: int | None = None
    minutes: float | None = None
    seed: int = 0
    device: str = "auto"
    method: str | None = None
    executor: str = LOCAL
    frames: int = FRAMES_PER_TEXTURE


@dataclass(frozen=True, eq=False)
class StudyCase:
    """A case with frames of known pose. with_frames: its textures that have frames; styles: those to leave out."""

    case: Case
    poses_path: Path
    camera: Camera
    frames: list[Frame]
    textures: list[str]
    with_frames: list[str]
    styles: list[str]
    method: str
    inputs: dict

    @property
    def folder(self) -> Path:
        return self.case.folder / "study"


def check_study(pairs, out_folder: Path, settings: StudySettings, progress: ProgressFunction) -> list[StudyCase]:
    """The cases of (case folder, poses file or None), opened. Raises InputError with every problem."""
    problems, studied = Problems(), []
    for word, chosen, known in (("protocols", settings.protocols, PROTOCOLS), ("preset", settings.presets, PRESETS)):
        for name in chosen:
            if name not in known:
                problems.add(f"--{word}: '{name}' is not known; there are {', '.join(known)}.")
    for name, value in (("steps", settings.steps), ("minutes", settings.minutes)):
        if value is not None and value <= 0:
            problems.add(f"--{name}: {value}; it must be above 0.")
    if settings.seed < 0:
        problems.add(f"--seed: {settings.seed}; give 0 or more.")
    for word, count in (("robustness-frames", settings.robustness_frames), ("frames", settings.frames)):
        if count < 1:
            problems.add(f"--{word}: {count}; give at least 1.")
    with problems.collect():
        check_out(out_folder)
    with problems.collect():
        check_executor(settings.executor)
    for case_folder, poses_path in pairs:
        with problems.collect():
            if poses_path is None:
                if problems.found:
                    continue  # drawing takes its time
                poses_path = _drawn(Path(case_folder), settings, progress)
            studied.append(open_studied(Path(case_folder), Path(poses_path).absolute(), settings))
    problems.raise_if_any()
    return studied


def _drawn(folder: Path, settings: StudySettings, progress: ProgressFunction) -> Path:
    def report(_fraction: float, text: str) -> None:
        progress(0.0, text)

    case = Case.open(folder)
    protocols = settings.protocols
    check_poses(case, settings.method, "strict" in protocols or settings.textures_study, "loto" in protocols)
    return drawn_frames(case, settings.method, settings.frames, settings.seed, report)


def open_studied(folder: Path, poses_path: Path, settings: StudySettings) -> StudyCase:
    """One of them. Raises InputError with every problem."""
    case = Case.open(folder)
    problems, camera, frames = Problems(), case.camera, []
    method, appearances = settings.method, []
    with problems.collect():
        camera, frames = known_frames(poses_path, None, case)
    with problems.collect():
        method, appearances = read_appearances(case, settings.method)
    problems.raise_if_any()
    textures = sorted({appearance.style for appearance in appearances})
    styles = [style for style in textures if any(frame.style == style for frame in frames)]
    if not styles:
        problems.add(
            f"{poses_path}: none of its frames has a style that is called like a texture of {folder} "
            f"({', '.join(textures)}); give each frame the name of its texture as 'style'."
        )
    for style in settings.styles or ():
        if style not in styles:
            problems.add(f"--styles: '{style}' has no frames or no appearances; there are {', '.join(styles)}.")
    least = LEFT_OUT + TEXTURE_COUNTS[0] if settings.textures_study else 2 if settings.protocols else 1
    if len(textures) < least:
        problems.add(
            f"{folder}: has appearances of {len(textures)} textures, at least {least} are needed; synthesise more."
        )
    if settings.textures_study and len(styles) < LEFT_OUT:
        problems.add(f"{poses_path}: has frames of {len(styles)} textures; --textures-study tests on {LEFT_OUT}.")
    chosen = [style for style in styles if settings.styles is None or style in settings.styles]
    registered = styles if settings.textures_study else chosen
    for frame in frames:  # one that cannot be read would end the study after all its trainings
        if frame.style in registered:
            with problems.collect():
                check_frame(frame, camera)
    if settings.robustness and (case.model_folder / "model.onnx").is_file():
        from ..registration.predictor import open_predictor

        with problems.collect():
            open_predictor(case)  # made by an older version it would end the study after all its trainings
    elif settings.robustness and not settings.protocols:
        problems.add(f"{folder}: has no model to test for robustness; run `train`, or study the protocol strict too.")
    problems.raise_if_any()
    inputs = {
        "vessels_sha256": case.vessels_sha256,
        "appearances_sha256": files.sha256(index_path(case, method)),
        "poses_sha256": files.sha256(poses_path),
        "frames_sha256": digest_of(frames),
    } | pose_settings(case.manifest)
    return StudyCase(case, poses_path, camera, frames, textures, styles, chosen, method, inputs)
