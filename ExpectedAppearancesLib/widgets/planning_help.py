"""Section Settings and help: missing packages, the system check, and what becomes of runs on closing."""

from __future__ import annotations

from pathlib import Path

import qt
import slicer
from slicer.i18n import tr as _

from ..runs import dependencies
from ..runs.system_report import SystemCheck, system_report
from .planning_qt import allow

KINDS = ("planning", "training")


class HelpSection:
    """Not a step of the work: always there, always closed at first."""

    def __init__(self, panel):
        self.panel, self.ui = panel, panel.ui
        self._checking: SystemCheck | None = None
        self._timer = qt.QTimer()
        self._timer.setInterval(200)
        self._timer.connect("timeout()", self._look)
        self._missing: dict[str, list[str]] | None = None
        self.ui.installButton.connect("clicked(bool)", lambda _checked=False: self.on_install())
        self.ui.installFolderButton.connect("clicked(bool)", lambda _checked=False: self.on_install_from_folder())
        self.ui.systemCheckButton.connect("clicked(bool)", lambda _checked=False: self.on_check())

    def enter(self) -> None:
        self._missing = None

    def refresh(self) -> None:
        names = sorted({name for kind in KINDS for name in self.missing(kind)})
        text = _("Missing Python packages: {names}.").format(names=", ".join(names))
        self.ui.missingLabel.text = text if names else _("All Python packages are there.")
        reason = "" if names else _("Nothing is missing.")
        if names and self.panel.running():  # what it has loaded must not be replaced beneath it
            reason = _("A run is going on, which uses these packages; wait until it is ready, or cancel it.")
        if dependencies.is_installing():
            reason = _("The packages are being installed.")
        allow(self.ui.installButton, reason, _("Download and install them; you are asked first."))
        allow(self.ui.installFolderButton, reason, _("Install them from a folder of wheels, without a network."))
        busy = _("The system is being checked.") if self._checking else ""
        allow(self.ui.systemCheckButton, busy, _("Versions, graphics cards, memory and disk, to copy into a mail."))

    def missing(self, kind: str) -> list[str]:
        """What has to be installed for "planning" or "training"; looked up once each time the module is entered."""
        if self._missing is None:
            self._missing = {kind: dependencies.missing(kind) for kind in KINDS}
        return self._missing[kind]

    def reason(self, kind: str) -> str:
        """Why nothing of this kind can be started; '' where all packages are there."""
        names = ", ".join(name.partition(">=")[0] for name in self.missing(kind))
        return (
            _("Python packages are missing: {names}. Install them in Settings and help.").format(names=names)
            if names
            else ""
        )

    def close(self) -> None:
        self._timer.stop()
        self._checking = None

    def on_install(self, wheels_folder: Path | None = None) -> None:
        if dependencies.is_installing():
            return

        def confirm(names: list[str]) -> bool:
            text = _("These Python packages will be installed into this Slicer:") + "\n\n" + "\n".join(names)
            return slicer.util.confirmOkCancelDisplay(text, windowTitle=_("Install Python packages"))

        said = _("The packages could not be installed.")
        try:
            with dependencies.installing(), slicer.util.tryWithErrorDisplay(said, waitCursor=True):
                for kind in KINDS:
                    if not dependencies.install(kind, wheels_folder, confirm):
                        break  # declined: not asked for more
        finally:  # what is displayed as an error ends this, too
            self._missing = None
            self.panel.refresh_soon()

    def on_install_from_folder(self) -> None:
        folder = qt.QFileDialog.getExistingDirectory(slicer.util.mainWindow(), _("Folder of wheels"), "")
        if folder:
            self.on_install(Path(folder))

    def on_check(self) -> None:
        """In a process of its own: it loads torch."""
        self._checking = SystemCheck()
        self._timer.start()
        self.panel.refresh_soon()

    def _look(self) -> None:
        report = self._checking.poll() if self._checking else None
        if report is None:
            return
        self.close()
        self.show_text(system_report(report) if report else _("The check could not be run; look into Slicer's log."))
        self.panel.refresh_soon()

    def show_text(self, text: str) -> None:
        box = qt.QMessageBox(slicer.util.mainWindow())
        box.setWindowTitle(_("System check"))
        box.setText(_("Copy this into your mail when you ask for help."))
        box.setDetailedText(text)
        copy = box.addButton(_("Copy"), qt.QMessageBox.AcceptRole)
        box.addButton(qt.QMessageBox.Close)
        box.exec_()
        if box.clickedButton() == copy:
            qt.QApplication.clipboard().setText(text)
