"""CASE/runs/KIND.json: which process works on the case, so that a later start of the program finds it again."""

from __future__ import annotations

import contextlib
import platform
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from .. import files
from ..errors import InputError

FORMAT = "ExpectedAppearances run"


@dataclass(frozen=True)
class RunRecord:
    """pid, created_s and mark together name one process: a pid alone is given to another one later."""

    kind: str
    pid: int
    created_s: float  # seconds since 1970, as psutil tells it
    mark: str  # in the environment of the process and of all it starts
    host: str
    started: str  # ISO 8601, UTC
    command: list[str]
    python: str
    log: str  # relative to the case, which may be moved
    cancelled: bool = False
    outcome: str = ""  # a RunState's value, once somebody has seen the end


def runs_folder(case_folder: Path) -> Path:
    return Path(case_folder) / "runs"


def record_path(case_folder: Path, kind: str) -> Path:
    return runs_folder(case_folder) / f"{kind}.json"


def read_record(case_folder: Path, kind: str) -> RunRecord | None:
    """The newest run of this kind that was started on this computer; None where there is none that can be read."""
    path = record_path(case_folder, kind)
    if not path.is_file():
        return None
    try:
        content = files.read_json(path, "record of a run")
        if not isinstance(content, dict) or content.pop("format", None) != FORMAT:
            return None
        record = RunRecord(**{f.name: content[f.name] for f in fields(RunRecord)})
    except (InputError, KeyError):
        return None
    if not isinstance(record.pid, int) or not isinstance(record.mark, str) or not record.mark:
        return None
    return record if record.host == platform.node() else None


def write_record(case_folder: Path, record: RunRecord) -> None:
    files.write_json(record_path(case_folder, record.kind), {"format": FORMAT} | asdict(record))


def update_record(case_folder: Path, record: RunRecord, **changes) -> RunRecord:
    """Write the changes unless a newer run has taken the place of this one; returns the changed record."""
    changed = replace(record, **changes)
    newest = read_record(case_folder, record.kind)
    if newest is not None and newest.mark == record.mark:
        # A case that has become unwritable must not keep the panel from showing how the run ended.
        with contextlib.suppress(InputError):
            write_record(case_folder, changed)
    return changed


@contextlib.contextmanager
def exclusive(case_folder: Path, name: str, timeout_s: float = 0.0) -> Iterator[None]:
    """Hold CASE/runs/NAME.lock for the block; the system frees it when the process ends, however it ends.

    Raises InputError when somebody else holds it.
    """
    from filelock import FileLock, Timeout

    path = runs_folder(case_folder) / f"{name}.lock"
    with files.writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(str(path))
        try:
            lock.acquire(timeout=timeout_s)
        except Timeout:
            raise InputError(
                f"{case_folder}: another {name} is going on in this case; wait until it has ended, or cancel it."
            ) from None
    try:
        yield
    finally:
        lock.release()
