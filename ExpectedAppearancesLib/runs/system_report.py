"""A text about this computer that the user can copy into a mail."""

from __future__ import annotations

import sys

from ..cli import check
from . import dependencies

PURPOSES = {"registration": "registering frames", "planning": "planning", "training": "synthesis and training"}


def system_report() -> str:
    """Everything that the command `check` prints, what each purpose still needs, and 3D Slicer's version.

    Takes some seconds: devices and rendering are tried in processes of their own.
    """
    lines = check.report_lines(check.make_report())
    for kind, purpose in PURPOSES.items():
        lacking = dependencies.missing(kind)
        lines.append(f"For {purpose}: {'lacks ' + ', '.join(lacking) if lacking else 'all packages are there'}")
    return "\n".join([*_slicer_lines(), *lines])


def _slicer_lines() -> list[str]:
    """Version and build of the application that this runs in, none outside it."""
    app = getattr(sys.modules.get("slicer"), "app", None)
    if app is None or not hasattr(app, "applicationVersion"):
        return []
    extensions = getattr(app, "extensionsManagerModel", lambda: None)()
    installed = getattr(extensions, "installedExtensions", ()) if extensions else ()
    return [
        f"3D Slicer {app.applicationVersion} (revision {app.repositoryRevision}, {app.platform})",
        f"Extensions: {', '.join(installed) or 'none'}",
    ]
