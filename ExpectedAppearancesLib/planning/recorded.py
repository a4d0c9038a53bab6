"""What a case folder holds, read for `steps.plan_steps`: only files that changed are read again."""

from __future__ import annotations

import contextlib
import json
import os
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .. import files
from ..appearances import METHODS
from ..appearances.store import folder_of, index_path, newest_image
from ..case.case import MANIFEST_NAME, Case
from ..errors import InputError
from ..evaluation.verdict import Figures, Limits, figures_of_model, figures_of_study, verdict
from .steps import Recorded, Study, drawn_from_elsewhere

STOPPED = ("cancelled", "failed")  # outcomes of a run as its record names them
LARGEST_HEADER_BYTES = 1 << 24


class CaseReader:
    """Reads one case folder again and again, cheaply. Each part is kept until its file changes."""

    def __init__(self) -> None:
        self._kept: dict[tuple, tuple] = {}
        self._case: Case | None = None
        self._overview: tuple = (None, False)  # what `overview_changed` depends on, its answer

    def case(self, folder: str, saved: bool = False) -> tuple[Case | None, str]:
        """The case and ''; None and what is wrong with the folder; None and '' where there is no case yet.

        saved: there was a case before, so that it is missed.
        """
        path = Path(folder) / MANIFEST_NAME
        if not folder or not os.path.isfile(path):  # unlike pathlib's, False on a network drive that is gone
            # A scene from another computer, a drive taken away, or a folder that was moved.
            # On Linux a folder of Windows is a name without a place.
            gone = folder and (saved or not path.is_absolute() or not os.path.isdir(path.parent.parent))
            text = f"{folder}: is not there. Connect its drive, open the case where it is now, or choose New."
            return None, text if gone else ""
        case, problem = self._once(path, self._open)
        if problem:  # a file that is restored leaves case.json as it was
            self._kept.pop((str(path), self._open.__name__), None)
        return case, problem

    def recorded(self, folder: str, method: str, limits: Limits, saved: bool = False) -> Recorded:
        """All that the steps of the case depend on; `method` is that of the appearances. saved: see `case`."""
        case, problem = self.case(folder, saved)
        if case is None:
            return Recorded(problem=problem)
        index, index_sha256 = self._once(index_path(case, method), _read_index) or (None, "")
        model = self._once(case.model_folder / "model.json", _read_object)
        rows, stale = self.figures(case)
        state = self._once(case.model_folder / "checkpoint.safetensors", training_state) or {}
        return Recorded(
            "",
            case.manifest,
            case.camera,
            index,
            self._overview_changed(case, index, index_sha256) if method == "surface" and index else False,
            model,
            index_sha256,
            state.get("step", 0),
            "stale" if stale else "known" if rows else "",
            verdict(rows, limits) if rows else None,
            self._study(case),
            self._poses_changed(case, index) if method == "image" and index else False,
            self._study_preset(case),
        )

    def figures(self, case: Case) -> tuple[list[Figures], bool]:
        """Rows of the validation table, study first, and whether the study is about others than the case's models."""
        model = self._once(case.model_folder / "model.json", _read_object)
        rows: list[Figures] = []
        study = self._once(case.folder / "study" / "study.json", _read_object)
        stale = False
        if study:
            try:
                rows = figures_of_study(study)
            except InputError:
                rows = []
            inputs = study.get("inputs") or {}
            used = inputs.get("appearances_sha256")
            indices = (self._once(index_path(case, m), _read_index) for m in METHODS)
            current = [index[1] for index in indices if index]
            of_model = case.manifest["stages"].get("train", {}).get("appearances_sha256")
            # Of one method's they say nothing of a model of the other's.
            stale = bool(used) and used not in ([of_model] if model and of_model in current else current)
            # Of another craniotomy, or of a narrower range, they say nothing of the model that was trained since.
            stale = stale or drawn_from_elsewhere(inputs, case.manifest)
            presets = {content["preset"] for content in (study, model or {}) if content.get("preset")}
            stale = bool(rows) and (stale or len(presets) > 1)
        if model:
            rows = rows + figures_of_model(model)
        return rows, stale

    def curve(self, case: Case) -> list[dict]:
        """[{"step", "loss", "validation_add_mm"}] of the last training, of its last checkpoint while it goes on."""
        state = self._once(case.model_folder / "checkpoint.safetensors", training_state) or {}
        if state.get("curve"):
            return state["curve"]
        return (self._once(case.model_folder / "training.json", _read_object) or {}).get("curve", [])

    def newest_image(self, case: Case, method: str) -> tuple[Path | None, int]:
        """The appearance that was finished last, and how many there are."""
        return self._once(folder_of(case, method), newest_image) or (None, 0)

    def _open(self, path: Path) -> tuple[Case | None, str]:
        try:
            case = Case.open(path.parent, lambda file: self._once(file, files.sha256))
        except InputError as error:
            return None, str(error)
        known = self._case
        if known and known.folder == case.folder and known.manifest["inputs"] == case.manifest["inputs"]:
            # Only stages were recorded: the meshes need not be read again.
            case.__dict__.update({n: known.__dict__[n] for n in ("vessels", "cortex") if n in known.__dict__})
        self._case = case
        return case, ""

    def _study(self, case: Case) -> Study:
        if (self._once(case.folder / "runs" / "study.json", _read_object) or {}).get("outcome") in STOPPED:
            return Study.STOPPED
        return Study.DONE if (case.folder / "study" / "study.json").is_file() else Study.NONE

    def _study_preset(self, case: Case) -> dict:
        words = (self._once(case.folder / "runs" / "study.json", _read_object) or {}).get("command") or []
        with contextlib.suppress(ValueError):  # one of them was left out
            name, minutes = (words[words.index(option) + 1] for option in ("--preset", "--minutes"))
            return {"name": name, "minutes": float(minutes)}
        return {}

    def _poses_changed(self, case: Case, index: dict) -> bool:
        made_from = index["settings"].get("poses_sha256")
        return made_from is not None and made_from != self._once(case.poses_path, files.sha256)

    def _overview_changed(self, case: Case, index: dict, index_sha256: str) -> bool:
        craniotomy = case.manifest["stages"].get("render", {}).get("craniotomy")
        version = (case.folder, str(case.manifest["inputs"]), str(craniotomy), index_sha256)
        if self._overview[0] != version:
            self._overview = (version, overview_changed(case, index))
        return self._overview[1]

    def _once(self, path: Path, read: Callable[[Path], object]):
        """read(path), again only where the file changed; None where there is no such file."""
        try:
            status = path.stat()
        except OSError:
            return None
        version = (status.st_mtime_ns, status.st_size)
        key = (str(path), read.__name__)
        if key not in self._kept or self._kept[key][0] != version:
            self._kept[key] = (version, read(path))
        return self._kept[key][1]


def training_state(path: Path) -> dict:
    """What the training put beside the tensors of its checkpoint: step, curve, best ADD. {} where it cannot be read.

    Read from the header alone: torch is not loaded for it.
    """
    try:
        with open(path, "rb") as stream:
            (length,) = struct.unpack("<Q", stream.read(8))
            if length > LARGEST_HEADER_BYTES:
                return {}
            header = json.loads(stream.read(length))
        return json.loads(header.get("__metadata__", {}).get("state", "{}"))
    except (OSError, ValueError, struct.error, AttributeError):
        return {}


def overview_changed(case: Case, index: dict) -> bool:
    """Whether method `surface` would look at the surface from elsewhere now than when the appearances were made."""
    from ..appearances.overview import overview_view
    from ..masks.stage import craniotomy_of, parenchyma_of

    made_from, size_px = index["settings"].get("overview"), index["settings"].get("size_px")
    if made_from is None or size_px is None:
        return False  # made by an older version, which did not say
    craniotomy = craniotomy_of(case)
    _, camera_from_world = overview_view(craniotomy, parenchyma_of(case, craniotomy), size_px)
    return not np.allclose(camera_from_world, np.asarray(made_from, float), atol=1e-3)


def _read_index(path: Path) -> tuple[dict | None, str]:
    index = _read_object(path)
    whole = bool(index) and isinstance(index.get("items"), list) and isinstance(index.get("settings"), dict)
    return (index, files.sha256(path)) if whole and "done" in index else (None, "")


def _read_object(path: Path) -> dict | None:
    """The JSON object in a file; None where it is damaged: the stage that wrote it is then as good as not done."""
    try:
        content = files.read_json(path, "file of the case")
    except InputError:
        return None
    return content if isinstance(content, dict) else None
