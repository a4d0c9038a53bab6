"""What this computer has, asked without waiting: for a panel, and as text that the user can copy into a mail."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile

from ..interpreter import python_for_runs
from . import dependencies
from .environment import WITHOUT_WINDOW, environment_of
from .system_findings import report_lines

PURPOSES = {"registration": "registering frames", "planning": "planning", "training": "synthesis and training"}


class SystemCheck:
    """`check --json` in a process of its own: devices with their memory, rendering, packages. Takes seconds."""

    def __init__(self) -> None:
        self._report: dict | None = None
        self._output = tempfile.TemporaryFile()  # noqa: SIM115 (closed once it is read)
        self._process = subprocess.Popen(
            [python_for_runs(), "-m", "ExpectedAppearancesLib", "check", "--json"],
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.DEVNULL,
            env=environment_of("check"),
            **WITHOUT_WINDOW,
        )

    def poll(self) -> dict | None:
        """The report of `check`, None while it goes on; never waits. {} when the check itself could not run."""
        if self._report is None and self._process.poll() is not None:
            self._output.seek(0)
            try:
                self._report = json.loads(self._output.read().decode("utf-8", errors="replace"))
            except ValueError:
                self._report = {}
            self._output.close()
        return self._report


def system_report(report: dict) -> str:
    """Everything that the command `check` prints, what each purpose still needs, and 3D Slicer's version.

    report: what SystemCheck.poll() has found.
    """
    lines = report_lines(report)
    for kind, purpose in PURPOSES.items():
        lacking = dependencies.missing(kind)
        lines.append(f"For {purpose}: {'lacks ' + ', '.join(lacking) if lacking else 'all packages are there'}")
    return "\n".join([*_slicer_lines(), *lines])


def _slicer_lines() -> list[str]:
    """Version and build of the application that this runs in, none outside it."""
    app = getattr(sys.modules.get("slicer"), "app", None)
    if app is None or not hasattr(app, "applicationVersion"):
        return []
    model = getattr(app, "extensionsManagerModel", None)
    installed = getattr(model() if callable(model) else model, "installedExtensions", ())
    return [
        f"3D Slicer {app.applicationVersion} (revision {app.repositoryRevision}, {app.platform})",
        f"Extensions: {', '.join(installed) or 'none'}",
    ]
