"""The trainings of a study: each in a process and a folder of its own; a finished one is not trained again."""

from __future__ import annotations

import contextlib
import re
import shutil
import subprocess
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .. import files
from ..errors import EXIT_BAD_INPUT, EXIT_CANCELLED, CancelledError, ExpectedAppearancesError, InputError
from ..interpreter import library_environment, python_for_runs

PROTOCOLS = ("strict", "loto")
COMMAND = (python_for_runs(), "-m", "ExpectedAppearancesLib")
PATIENCE_S = 20.0  # that a stopped training is given to save what it has; a run that is cancelled has 30
_PROGRESS = re.compile(r"^\s*(\d+) %  (.*?)(?: \([^()]* left\))?$")  # the time left is the fold's, not the study's
SPACE_MB = {"fold": 60.0, "under way": 400.0}  # of a finished fold, and of a training with its checkpoint


@dataclass(frozen=True)
class FoldJob:
    """One training. name: of its folder in CASE/study/folds. protocol: 'strict' (every view has a pose of its own),
    'loto' (the paper's: views repeat the poses of `poses_path`) or 'textures' (as strict, for a number of textures).
    settings: all that the model depends on, JSON."""

    case_folder: str
    name: str
    protocol: str
    preset: str
    exclude: tuple[str, ...]
    poses_path: str
    seed: int
    device: str
    method: str
    steps: int | None
    minutes: float | None
    settings: dict

    @property
    def folder(self) -> Path:
        return Path(self.case_folder) / "study" / "folds" / self.name

    @property
    def title(self) -> str:
        """Which model it is, for people."""
        if self.protocol == "textures":
            return f"{self.preset} model of {int(self.name.rpartition('-')[2])} textures"
        poses = "seen" if self.protocol == "loto" else "unseen"
        return f"{self.preset} model without {', '.join(self.exclude)}, {poses} poses"

    def arguments(self) -> list[str]:
        """Of the `train` command."""
        words = ["train", self.case_folder, "--model-folder", self.folder, "--preset", self.preset]
        words += ["--seed", self.seed, "--device", self.device, "--appearances", self.method]
        words += ["--exclude", *self.exclude] if self.exclude else []
        words += ["--poses", self.poses_path] if self.protocol == "loto" else []
        words += ["--no-inner-texture"] if self.protocol == "textures" else []
        for name in ("steps", "minutes"):
            if getattr(self, name) is not None:
                words += [f"--{name}", getattr(self, name)]
        return [str(word) for word in words]


def is_trained(job: FoldJob) -> bool:
    """Whether the fold's folder holds the whole model that these settings give."""
    record = _read_record(job)
    model = job.folder / "model.onnx"
    if record.get("settings") != job.settings or not record.get("done") or not model.is_file():
        return False
    return files.sha256(model) == record.get("model_sha256")


def train_fold(
    job: FoldJob,
    progress: Callable[[float, str], None] = lambda _fraction, _message: None,
    stopped: Callable[[], bool] = lambda: False,
) -> None:
    """Train the fold unless it is trained; goes on where an interrupted training of the same settings was.

    stopped: asked now and then; when it says so the training is ended and CancelledError raised. Whatever is raised,
    no process is left behind.
    """
    if is_trained(job):
        return
    if _read_record(job).get("settings") != job.settings:
        shutil.rmtree(job.folder, ignore_errors=True)
        files.write_json(job.folder / "fold.json", {"settings": job.settings, "done": False})
    process = subprocess.Popen(
        [*COMMAND, *job.arguments()],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        env=library_environment(),
    )
    said: list[str] = []
    reader = threading.Thread(target=_read_lines, args=(process.stderr, said), daemon=True)
    reader.start()
    shown = 0
    try:
        while process.poll() is None:
            if stopped():
                raise CancelledError("The study was stopped; finished folds are kept.")
            for line in said[shown:]:
                shown += 1
                match = _PROGRESS.match(line)
                if match:
                    progress(int(match[1]) / 100, f"{job.title}: {match[2]}")
            time.sleep(0.2)
    finally:
        _end(process)
    reader.join(5)
    _check_exit(job, process.returncode, said)
    model_sha256 = files.sha256(job.folder / "model.onnx")
    (job.folder / "checkpoint.safetensors").unlink(missing_ok=True)  # several times the model's size, of use no more
    files.write_json(job.folder / "fold.json", {"settings": job.settings, "done": True, "model_sha256": model_sha256})


def _read_record(job: FoldJob) -> dict:
    with contextlib.suppress(InputError):
        record = files.read_json(job.folder / "fold.json", "fold")
        return record if isinstance(record, dict) else {}
    return {}


def _read_lines(stream, said: list[str]) -> None:
    for line in stream:
        said.append(line.rstrip("\n"))


def _end(process: subprocess.Popen) -> None:
    if process.poll() is not None:
        return
    process.terminate()
    try:
        process.wait(PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _check_exit(job: FoldJob, code: int, said: list[str]) -> None:
    if code == 0:
        return
    words = [line for line in said if line.strip() and not _PROGRESS.match(line)]
    text = f"training of {job.name}: " + ("\n".join(words[-12:]) or f"ended with exit code {code}")
    if code == EXIT_CANCELLED:
        raise CancelledError(text)
    raise InputError(text) if code == EXIT_BAD_INPUT else ExpectedAppearancesError(text)
