"""The section that records, looks at recordings again, and exports them."""

from __future__ import annotations

from pathlib import Path

import slicer
from slicer.i18n import tr as _

from ..errors import InputError
from ..live.status import Status
from ..mrml import live_record
from ..mrml.live_controller import LiveController
from .refreshing import quiet, set_text


class RecordSection:
    """parameters: callable that gives the parameter node, or None. say: shows a text to the user. moved: called when
    a recording that is looked at is at another frame."""

    def __init__(self, ui, controller: LiveController, parameters, say, moved):
        self._ui, self._controller, self._parameters, self._say = ui, controller, parameters, say
        self._moved = moved
        self._watched: list[tuple] = []
        ui.recordButton.connect("toggled(bool)", self._on_record)
        ui.browserComboBox.connect("currentNodeChanged(vtkMRMLNode*)", self._on_browser)
        ui.replaySlider.connect("valueChanged(int)", self._on_slider)
        ui.exportButton.connect("clicked(bool)", lambda _checked=False: self._on_export())

    def show(self, can_record: bool) -> Status | None:
        """Called on every tick; returns what a recording that is looked at shows, None while live or without one."""
        ui, recorder = self._ui, self._controller.recorder
        if recorder is not None and recorder.full:
            self._stop()
            self._say(_("Recording stopped at its limit; save the scene, or raise the limit."))
            recorder = None
        recording = recorder is not None
        if ui.recordButton.checked != recording:
            with quiet(ui.recordButton):
                ui.recordButton.checked = recording
        ui.recordButton.enabled = can_record or recording
        if recording:
            text = _("● {frames} frames, {mb} MB").format(frames=recorder.frames, mb=round(recorder.mb))
            set_text(ui.recordLabel, text)
        else:
            set_text(ui.recordLabel, "")
        browser = self._browser()
        self._watch([] if self._controller.running else live_record.recordings(slicer.mrmlScene))
        ui.exportButton.enabled = browser is not None and not recording
        ui.replaySlider.enabled = browser is not None and not self._controller.running
        if browser is None:
            return None
        last = max(browser.GetNumberOfItems() - 1, 0)
        if ui.replaySlider.maximum != last:
            ui.replaySlider.maximum = last
        if ui.replaySlider.value != browser.GetSelectedItemNumber():
            with quiet(ui.replaySlider):
                ui.replaySlider.value = browser.GetSelectedItemNumber()
        return self._replay(browser)

    def close(self) -> None:
        """Let go of the recordings."""
        self._watch([])

    def _watch(self, browsers: list) -> None:
        """Follow them at once: Slicer shows their next frame before the next tick, and the overlay is of the last.

        Ticks are rare while nothing runs, and rarer still while the computer is busy.
        """
        if browsers == [browser for browser, _tag in self._watched]:
            return
        for browser, tag in self._watched:
            browser.RemoveObserver(tag)
        self._watched = [(browser, browser.AddObserver("ModifiedEvent", self._on_moved)) for browser in browsers]

    def _on_moved(self, browser, _event) -> None:
        p = self._parameters()
        if p is None or self._controller.running or slicer.mrmlScene.IsBatchProcessing():
            return
        if p.browser is not browser:  # Slicer's toolbar plays another one than was chosen here
            p.browser = browser
        self._moved()

    def _replay(self, browser) -> Status | None:
        p = self._parameters()
        # While a scene is loaded Slicer lets timers run: nodes made then would be mixed up with those that come.
        if self._controller.running or p is None or slicer.mrmlScene.IsBatchProcessing():
            return None
        try:
            return self._controller.look_at(browser, p.casePath)
        except InputError as error:
            self._say(str(error))
            p.browser = None
            return self._controller.status

    def _browser(self):
        """The recording that is chosen, if it is one of this panel."""
        p = self._parameters()
        chosen = p.browser if p is not None else None
        return chosen if chosen is not None and chosen.GetAttribute(live_record.BROWSER_ATTRIBUTE) else None

    def refresh(self) -> None:
        """From the parameter node to the widget."""
        p = self._parameters()
        if p is not None and self._ui.browserComboBox.currentNode() is not p.browser:
            self._ui.browserComboBox.setCurrentNode(p.browser)

    def _on_browser(self, node) -> None:
        p = self._parameters()
        if p is not None and p.browser is not node:
            p.browser = node

    def _on_record(self, checked: bool) -> None:
        try:
            if checked:
                self._controller.start_recording(self._parameters().limitMb)
            else:
                self._stop()
        except InputError as error:
            self._say(str(error))

    def _stop(self) -> None:
        browser = self._controller.stop_recording()
        if browser is not None:
            self._parameters().browser = browser

    def _on_slider(self, item: int) -> None:
        browser = self._browser()
        if browser is not None and not self._controller.running:
            browser.SetSelectedItemNumber(item)

    def _on_export(self) -> None:
        browser, folder = self._browser(), self._ui.exportPathLineEdit.currentPath
        if not folder:
            self._say(_("Choose a folder for the export."))
            return
        if Path(folder).is_dir() and any(Path(folder).iterdir()):
            self._say(_("{folder} is not empty; choose a new folder.").format(folder=folder))
            return
        with slicer.util.tryWithErrorDisplay(_("The recording could not be exported."), waitCursor=True):
            case = self._controller.open_case(self._parameters().casePath)
            path = live_record.export(browser, Path(folder), case)
            self._say(_("Exported to {path}.").format(path=path), done=True)
