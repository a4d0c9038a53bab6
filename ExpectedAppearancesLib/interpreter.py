"""The Python interpreter and the environment of the library in a process of its own, in 3D Slicer and outside it."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

LIBRARY_PARENT = Path(__file__).resolve().parents[1]


def python_for_runs(executable: str | None = None) -> str:
    """The Python interpreter that a run is started with.

    In 3D Slicer `sys.executable` is the application or the launcher PythonSlicer; the interpreter that its own
    command-line modules use is python-real, beside it or on the PATH.
    """
    executable = sys.executable if executable is None else executable
    name = Path(executable).stem.lower()
    if name.startswith("python") and not name.startswith("pythonslicer"):
        return executable
    suffix = ".exe" if os.name == "nt" else ""
    folders = [Path(executable).parent] if executable else []
    if os.environ.get("SLICER_HOME"):
        folders.append(Path(os.environ["SLICER_HOME"]) / "bin")
    for candidate in ("python-real", "PythonSlicer"):
        for folder in folders:
            if (folder / f"{candidate}{suffix}").is_file():
                return str(folder / f"{candidate}{suffix}")
        found = shutil.which(candidate)
        if found:
            return found
    return executable


def library_environment() -> dict[str, str]:
    """This process's environment, in which the library is found and paths of any language are printed."""
    environment = dict(os.environ)
    paths = [path for path in environment.get("PYTHONPATH", "").split(os.pathsep) if path]
    if str(LIBRARY_PARENT) not in paths:
        paths.append(str(LIBRARY_PARENT))
    environment["PYTHONPATH"] = os.pathsep.join(paths)
    environment.update(PYTHONUTF8="1", PYTHONUNBUFFERED="1")
    # NumPy solves small systems only. Its threads would give way to every other process while they wait for each other:
    # on a busy computer the end of a training took a quarter of an hour instead of a second.
    environment.setdefault("OPENBLAS_NUM_THREADS", "1")
    return environment
