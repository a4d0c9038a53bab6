"""What registration needs besides Slicer, and installing it after asking."""

from __future__ import annotations

import importlib.util

import slicer
from slicer.i18n import tr as _

REQUIRED = {"onnxruntime": "onnxruntime", "cv2": "opencv-python-headless"}


def missing() -> list[str]:
    """Packages that are not installed, by the names that pip knows; nothing is imported."""
    return [package for module, package in REQUIRED.items() if importlib.util.find_spec(module) is None]


def problem() -> str:
    """What is missing, in words, or ''."""
    packages = missing()
    if not packages:
        return ""
    return _("This Slicer lacks {packages}; install it with the button below.").format(packages=", ".join(packages))


def install(say) -> bool:
    """Ask, then install. False when the user declined or it failed; `say` is told why."""
    packages = missing()
    if not packages:
        return True
    question = _("{packages} will be installed into this Slicer from the Internet. Go on?")
    if not slicer.util.confirmOkCancelDisplay(question.format(packages=", ".join(packages))):
        return False
    try:
        slicer.util.pip_install(packages)
    except Exception as error:  # pip's own failure: its output is in Slicer's log
        say(
            _(
                "{packages} could not be installed ({error}). Without Internet, install from a folder of wheels in the "
                "Python console: slicer.util.pip_install('--no-index --find-links FOLDER {packages}')."
            ).format(packages=" ".join(packages), error=error)
        )
        return False
    return not missing()
