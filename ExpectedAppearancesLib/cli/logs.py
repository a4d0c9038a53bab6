"""A log file for every run: in the case where there is one, else in the user's state folder."""

from __future__ import annotations

import contextlib
import datetime
import logging
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from .. import __version__


def state_folder() -> Path:
    """Where this user's programs keep logs."""
    if os.name == "nt":
        base = os.environ.get("LOCALAPPDATA") or tempfile.gettempdir()
    else:
        base = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(base) / "expected-appearances" / "logs"


@contextlib.contextmanager
def log_file(command: str, case_folder: Path | None) -> Iterator[Path | None]:
    """Send `logging` to a new file CASE/logs/<UTC time>-<command>.log for the block.

    Without a case the file is in the user's state folder. Yields its path, None where nothing can be written.
    """
    folders = []
    if case_folder and os.path.isfile(Path(case_folder) / "case.json"):  # False, too, where one may not look
        folders.append(Path(case_folder).absolute() / "logs")
    for usual in (state_folder, tempfile.gettempdir):
        # A user without a home, as services have none; disks that are all full.
        with contextlib.suppress(RuntimeError, OSError):
            folders.append(Path(usual()))
    path, handler = _first_writable(folders, f"{datetime.datetime.now(datetime.timezone.utc):%Y%m%dT%H%M%SZ}-{command}")
    root = logging.getLogger()
    usual_level = root.level
    if handler:
        handler.handleError = lambda _record: None  # a full disk ends the log, not the command
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        root.addHandler(handler)
        root.setLevel(min(usual_level, logging.INFO))
    logging.captureWarnings(True)
    logging.info(
        "ExpectedAppearances %s, Python %s, %s: %s",
        __version__,
        platform.python_version(),
        platform.platform(),
        sys.argv,
    )
    try:
        yield path
    finally:
        logging.captureWarnings(False)
        root.setLevel(usual_level)
        if handler:
            root.removeHandler(handler)
            with contextlib.suppress(OSError):
                handler.close()


def _first_writable(folders: list[Path], stem: str) -> tuple[Path | None, logging.Handler | None]:
    for folder in folders:
        for attempt in range(1, 100):
            path = folder / (f"{stem}.log" if attempt == 1 else f"{stem}-{attempt}.log")
            try:
                folder.mkdir(parents=True, exist_ok=True)
                return path, logging.FileHandler(path, mode="x", encoding="utf-8", errors="backslashreplace")
            except FileExistsError:
                continue  # another run began in the same second
            except OSError:
                break
    return None, None
