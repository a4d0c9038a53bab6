"""Whether what a run has left in the case is whole, and what must go when it was ended in the middle."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterable
from pathlib import Path

from .. import files
from ..errors import InputError

STAGES = ("render", "synthesize", "train")  # those that case.json has a record of


def result_problem(kind: str, case_folder: Path, thorough: bool = False) -> str:
    """Why the result of a run of this kind is not whole, '' when it is (or when the kind leaves none on record).

    thorough: hash and open the model, too; takes a second.
    """
    folder = Path(case_folder)
    if kind == "study":
        return _study_problem(folder / "study" / "study.json")
    if kind not in STAGES:
        return ""
    try:
        stage = files.read_json(folder / "case.json", "case manifest")["stages"].get(kind, {})
        if stage.get("done", kind == "render") is not True:
            return f"{folder / 'case.json'}: says that '{kind}' is not finished; start it again, it goes on from there."
        if kind == "synthesize":
            _check_appearances(folder / "appearances" / stage["method"])
        elif kind == "train":
            _check_model(folder / "model", stage["model_sha256"], thorough)
    except InputError as error:
        return str(error)
    except (KeyError, TypeError, AttributeError):
        return f"{folder / 'case.json'}: its record of '{kind}' is not whole; start it again."
    return ""


def remove_partial_files(case_folder: Path, pids: Iterable[int]) -> None:
    """Remove what `files.replacing` leaves behind when its process is killed; those processes must have ended."""
    for pid in pids:
        with contextlib.suppress(OSError):  # the drive is gone
            for path in Path(case_folder).rglob(f".*.{pid}.part*"):
                with contextlib.suppress(OSError):
                    path.unlink()


def _study_problem(path: Path) -> str:
    from ..evaluation.verdict import figures_of_study

    try:
        return "" if figures_of_study(files.read_json(path, "study")) else f"{path}: holds no figures; start it again."
    except InputError as error:
        return str(error)


def _check_appearances(folder: Path) -> None:
    index = files.read_json(folder / "index.json", "index of the expected appearances")
    if index["done"] is not True or not index["items"]:
        raise InputError(f"{folder / 'index.json'}: not finished; start the synthesis again, it goes on from there.")
    for item in index["items"]:
        if not (folder / item["image"]).is_file():
            raise InputError(f"{folder / item['image']}: expected appearance missing; start the synthesis again.")


def _check_model(folder: Path, recorded_sha256: str, thorough: bool) -> None:
    path = folder / "model.onnx"
    if not path.is_file() or path.stat().st_size == 0:
        raise InputError(f"{path}: trained model missing; start the training again.")
    if files.read_json(folder / "model.json", "trained model")["model_sha256"] != recorded_sha256:
        raise InputError(f"{folder / 'model.json'}: belongs to another model; start the training again.")
    if not thorough:
        return
    if files.sha256(path) != recorded_sha256:
        raise InputError(f"{path}: damaged (SHA-256 differs from case.json); start the training again.")
    if importlib.util.find_spec("onnxruntime") is not None:
        from ..registration.predictor import Predictor

        Predictor(folder)
