"""What registration needs besides Slicer, and installing it after asking, from the Internet or a folder of wheels."""

from __future__ import annotations

from pathlib import Path

import qt
import slicer
from slicer.i18n import tr as _

from ..errors import ExpectedAppearancesError
from ..runs import dependencies

KIND = "registration"


def problem() -> str:
    """What is missing, in words, or ''. Looks at the disk: not for every tick."""
    packages = dependencies.missing(KIND)
    if not packages:
        return ""
    return _("This Slicer lacks {packages}; install it with the button below.").format(packages=", ".join(packages))


def install(say) -> bool:
    """Ask, then install. False when the user declined or it failed; `say` is told why."""
    chosen = _ask()
    if chosen is None:
        return False
    qt.QApplication.setOverrideCursor(qt.Qt.WaitCursor)
    try:
        return dependencies.install(KIND, chosen or None, lambda _packages: True, say)
    except ExpectedAppearancesError as error:
        say(str(error))
        return False
    finally:
        qt.QApplication.restoreOverrideCursor()


def _ask():
    """Path of a folder of wheels, '' for the Internet, None when the user declines."""
    box = qt.QMessageBox(slicer.util.mainWindow())
    box.setWindowTitle(_("Install what registration needs"))
    box.setText(
        _("{packages} will be installed into this Slicer.").format(packages=", ".join(dependencies.missing(KIND)))
    )
    internet = box.addButton(_("From the Internet"), qt.QMessageBox.AcceptRole)
    wheels = box.addButton(_("From a folder of wheels..."), qt.QMessageBox.ActionRole)
    box.addButton(qt.QMessageBox.Cancel)
    box.exec_()
    if box.clickedButton() == internet:
        return ""
    if box.clickedButton() != wheels:
        return None
    folder = qt.QFileDialog.getExistingDirectory(slicer.util.mainWindow(), _("Folder of wheels (*.whl)"))
    return Path(folder) if folder else None
