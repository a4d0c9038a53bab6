"""With which script and which environment a run is started, in 3D Slicer and outside it."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from ..interpreter import LIBRARY_PARENT, library_environment, python_for_runs
from .processes import MARK_VARIABLE

# Kinds of runs that are command-line modules of 3D Slicer; any other command runs through the library itself.
MODULES = {"synthesize": "ExpectedAppearancesSynthesis", "train": "ExpectedAppearancesTraining"}

# For Popen: on Windows a program of the terminal opens a black window, else, wherever a panel starts it.
WITHOUT_WINDOW = {"creationflags": subprocess.CREATE_NO_WINDOW} if os.name == "nt" else {}


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
    program = [str(script)] if script else ["-m", "ExpectedAppearancesLib.cli.command_line_module", kind]
    # The case comes first: an option that takes several values would swallow it.
    return [python or python_for_runs(), *program, str(case_folder), *arguments]


def environment_of(mark: str) -> dict[str, str]:
    """The environment of a run, which its mark tells from other processes."""
    return library_environment() | {MARK_VARIABLE: mark}
