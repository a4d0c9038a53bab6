"""CASE/runs/KIND.json: which process works on the case, so that a later start of the program finds it again."""

from __future__ import annotations

import contextlib
import datetime
import importlib.util
import logging
import os
import platform
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

from .. import files
from ..errors import InputError

FORMAT = "ExpectedAppearances run"
LOOK_EVERY_S = 0.5
NAMED_WITHIN_S = 2.0  # a holder of a lock has written who it is
# What goes on under a lock of this name, in the user's words.
NAMES = {
    "render": "drawing of label maps",
    "synthesize": "synthesis of other expected appearances",
    "train": "a training",
    "study": "a study",
}


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
    if not os.path.isfile(path):
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
    return record if record.host == platform.node() and not _is_of_another_case(record, case_folder) else None


def _is_of_another_case(record: RunRecord, case_folder: Path) -> bool:
    """Whether the run works on another folder, of which this one is a copy; not where that was moved to here."""
    worked_on = [word for word in record.command if os.path.isfile(Path(word) / "case.json")]
    return bool(worked_on) and not any(os.path.samefile(folder, case_folder) for folder in worked_on)


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


def obey_record(case_folder: Path, kind: str, mark: str) -> threading.Thread:
    """Raise SIGTERM in this process once the record of its run says that it is cancelled: for Windows, where no other
    process can. Returns the thread that looks."""

    def look() -> None:
        while True:
            record = read_record(case_folder, kind)
            if record is not None and record.mark == mark and record.cancelled:
                signal.raise_signal(signal.SIGTERM)  # its handler is called in the main thread
                return
            time.sleep(LOOK_EVERY_S)

    thread = threading.Thread(target=look, name="cancelled?", daemon=True)
    thread.start()
    return thread


@contextlib.contextmanager
def exclusive(folder: Path, name: str, timeout_s: float = 0.0, work: str = "") -> Iterator[None]:
    """Hold FOLDER/runs/NAME.lock for the block; the system frees it when the process ends, however it ends.

    work: what is done, where several processes may do it together: one that does the same as the holder is let in.
    Raises InputError, which names the holder, when somebody else holds it.
    """
    path = _lock_path(folder, name)
    with files.writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = _locked(path, timeout_s)
    if lock is None:
        holder = _holder(path)
        if not work or holder.get("work") != work:
            raise InputError(_occupied(folder, name, holder))
    try:
        if lock:
            _write_holder(path, work)
        yield
    finally:
        if lock:
            with contextlib.suppress(OSError):
                _holder_path(path).unlink()
            lock.release()


def refuse_if_occupied(folder: Path, kinds: Iterable[str] = tuple(NAMES)) -> None:
    """Raise InputError, which names it, where a run of one of these kinds goes on in the case, whoever started it."""
    if importlib.util.find_spec("filelock") is None:
        return
    for kind in kinds:
        path = _lock_path(folder, kind)
        if os.path.exists(path):  # in a case that cannot be written there is none to be made
            with files.writing(path):
                lock = _locked(path, 0.0)
            if lock is None:
                raise InputError(_occupied(folder, kind, _holder(path)))
            lock.release()


def _lock_path(folder: Path, name: str) -> Path:
    return runs_folder(folder) / f"{name}.lock"


def _locked(path: Path, timeout_s: float):
    """The lock, held; None while another process holds it, which then has written who it is."""
    from filelock import FileLock, Timeout

    lock, deadline = FileLock(str(path)), time.monotonic() + NAMED_WITHIN_S
    while True:
        try:
            lock.acquire(timeout=timeout_s)
            return lock
        except Timeout:
            if _holder(path) or time.monotonic() > deadline:
                return None
            time.sleep(0.05)
        except NotImplementedError:  # a network drive that knows no locks
            logging.warning("%s: cannot be locked; see to it that nobody else works on this case", path)
            return lock


def _holder_path(lock_path: Path) -> Path:
    # Beside the lock: Windows lets nobody read a file that is locked.
    return lock_path.with_suffix(".holder.json")


def _write_holder(lock_path: Path, work: str) -> None:
    since = datetime.datetime.now(datetime.timezone.utc).isoformat(timespec="seconds")
    # Whoever cannot be named holds the lock nevertheless.
    with contextlib.suppress(InputError):
        files.write_json(
            _holder_path(lock_path), {"pid": os.getpid(), "host": platform.node(), "since": since, "work": work}
        )


def _holder(lock_path: Path) -> dict:
    """What the holder has written; {} where it has not yet, or only one that was killed has."""
    try:
        content = files.read_json(_holder_path(lock_path), "holder of a lock")
        if content["host"] == platform.node():
            import psutil

            return content if psutil.pid_exists(content["pid"]) else {}
        return content
    except (InputError, ImportError, KeyError, TypeError):
        return {}


def by_the_clock(moment: str) -> str:
    """A time of a record (ISO 8601, UTC) as the clock of this computer shows it."""
    return f"{datetime.datetime.fromisoformat(moment).astimezone():%Y-%m-%d %H:%M}"


def _occupied(folder: Path, name: str, holder: dict) -> str:
    who = ""
    if holder:
        where = "" if holder.get("host") == platform.node() else f" on {holder.get('host')}"
        who = f" (process {holder.get('pid')}{where}, since {by_the_clock(holder['since'])})"
    return f"{folder}: {NAMES.get(name, name)} is going on in it{who}; wait until it has ended, or cancel it."
