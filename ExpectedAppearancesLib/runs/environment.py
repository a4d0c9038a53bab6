"""With which Python, which script and which environment a run is started, in 3D Slicer and outside it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from .processes import MARK_VARIABLE

LIBRARY_PARENT = Path(__file__).resolve().parents[2]
# Kinds of runs that are command-line modules of 3D Slicer; any other command runs through the library itself.
MODULES = {"synthesize": "ExpectedAppearancesSynthesis", "train": "ExpectedAppearancesTraining"}

# For Popen: on Windows a program of the terminal opens a black window, else, wherever a panel starts it.
WITHOUT_WINDOW = {"creationflags": subprocess.CREATE_NO_WINDOW} if os.name == "nt" else {}


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


def script_of(kind: str, library_parent: Path = LIBRARY_PARENT) -> Path | None:
    """The command-line module for a kind of run: in the source tree, or in the cli-modules folder of an extension."""
    name = MODULES.get(kind)
    if name is None:
        return None
    installed = library_parent.parent / "cli-modules"
    candidates = [library_parent / "ExpectedAppearances" / name / f"{name}.py", installed / f"{name}.py"]
    candidates += sorted(installed.glob(f"*/{name}.py"))  # a build with several configurations
    return next((path for path in candidates if path.is_file()), None)


def command_of(kind: str, case_folder: Path, arguments: list[str], python: str | None = None) -> list[str]:
    script = script_of(kind)
    program = [str(script)] if script else ["-m", "ExpectedAppearancesLib.runs.command_line_module", kind]
    # The case comes first: an option that takes several values would swallow it.
    return [python or python_for_runs(), *program, str(case_folder), *arguments]


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


def environment_of(mark: str) -> dict[str, str]:
    """The environment of a run, which its mark tells from other processes."""
    return library_environment() | {MARK_VARIABLE: mark}
