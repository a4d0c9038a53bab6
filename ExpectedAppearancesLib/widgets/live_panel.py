"""The live panel: joins its sections, one timer and one controller. The module's widget only forwards to it."""

from __future__ import annotations

import json

import qt
import slicer
from slicer.i18n import tr as _

from ..errors import ExpectedAppearancesError
from ..geometry.camera import Camera
from ..live.status import IDLE
from ..live.trust import Controls, controls
from ..mrml.live_controller import LiveController
from ..mrml.live_scene import OverlayOptions
from ..mrml.mri import scan_to_show
from ..runs import dependencies
from . import live_install
from .drawing import DrawnInTurn
from .live_align import AlignSection
from .live_layout import LayoutSection
from .live_record import RecordSection
from .live_source import SourceSection
from .live_status import StatusSection
from .refreshing import set_text

TICK_MS = 4
# Slicer holds Python's lock while it waits for events: only during this pause do the session's threads get it.
WAIT_S = 0.008
PROBLEM_STYLE, DONE_STYLE = "color: #c0392b; font-weight: bold;", "font-weight: bold;"
IDLE_TICKS = 12  # while nothing runs, one tick in so many does work


class LivePanel:
    """ui: the widgets by name. controller: of the module's logic."""

    def __init__(self, ui, controller: LiveController):
        self.ui, self.controller = ui, controller
        drawing = DrawnInTurn()
        controller.drawing_held = lambda: drawing
        self._parameter_node = None
        self._gui_tag = None
        self._message = ""
        self._choice = None  # that the message is about
        self._problem = ""
        self._starting = False
        self._missing = live_install.problem()
        self._ticks = 0
        self._fit_due = False
        self._buttons: tuple | None = None
        self._camera = None
        self.layout = LayoutSection()
        self.status = StatusSection(ui)
        self.source = SourceSection(ui, self.parameters, self.refresh)
        self.align = AlignSection(ui, controller, self.say)
        self.record = RecordSection(ui, controller, self.parameters, self.say, self.tick_now)
        ui.startButton.connect("clicked(bool)", lambda _checked=False: self.toggle())
        ui.freezeButton.connect("clicked(bool)", self.freeze)
        ui.singleButton.connect("clicked(bool)", lambda _checked=False: self.single())
        ui.installButton.connect("clicked(bool)", lambda _checked=False: self.install())
        ui.layoutButton.connect("clicked(bool)", lambda _checked=False: self.show_views())
        ui.fitButton.connect("clicked(bool)", lambda _checked=False: self.fit())
        self._timer = qt.QTimer()
        self._timer.setInterval(TICK_MS)
        self._timer.connect("timeout()", self.tick)

    def parameters(self):
        return self._parameter_node

    def enter(self) -> None:
        self.show_views()
        self.restore()
        self._timer.start()

    def restore(self) -> None:
        """Put the views onto the frame that a loaded scene brought, without an overlay: nobody judges it yet."""
        p = self._parameter_node
        if p is None or self.controller.running or not p.cameraJson or not p.casePath:
            return
        try:
            camera = Camera.from_dict(json.loads(p.cameraJson), "scene: camera of the last frame")
            self.controller.restore(p.casePath, camera)
        except (ExpectedAppearancesError, ValueError) as error:
            self.say(str(error))

    def leave(self) -> None:
        """Another module is opened: the session goes on no further, since nobody would see whether to trust it."""
        self._timer.stop()
        self.stop()
        self.record.close()
        self.controller.leave()  # a recording that is looked at has come back with the end of the session
        self.layout.leave()

    def close(self) -> None:
        """Leave nothing behind: no timer, thread, node, banner or observer."""
        self._timer.stop()
        self.align.close()
        self.record.close()
        self.controller.close()
        self.layout.leave()
        self.set_parameter_node(None)

    def scene_closed(self) -> None:
        """The nodes are gone; threads must not outlive them."""
        self.record.close()
        self.controller.forget_scene()
        self.align.close()
        self.status.show(IDLE)

    def set_parameter_node(self, parameter_node) -> None:
        if self._parameter_node is not None:
            self._parameter_node.disconnectGui(self._gui_tag)
        self._parameter_node = parameter_node
        self._camera = None  # that of a new scene is not known yet
        if parameter_node is not None:
            self._gui_tag = parameter_node.connectGui(self.ui)
            self.refresh()

    def refresh(self) -> None:
        """After any change of a parameter."""
        p = self._parameter_node
        if p is None:
            return
        self.source.refresh(self.controller.running)
        self.record.refresh()
        if self._missing:
            self._missing = live_install.problem()
        self._problem = self._missing or self.source.problem()
        choice = self.source.choice()
        if choice != self._choice:  # what was wrong with the one before would hide what is wrong with this one
            self._choice = choice
            self.say("")
        self.ui.installButton.visible = bool(self._missing)
        self.controller.set_stale(p.staleMs / 1000)
        try:
            self.controller.set_steady(p.steady)
        except ExpectedAppearancesError as error:
            p.steady = False
            self.say(str(error))
        options = OverlayOptions(p.outline, p.fill, p.fillOpacity, p.box)
        if options != self.controller.options:
            self.controller.set_options(options)
        if self.layout.active and self.layout.show_mri(p.mriVolume):
            self._fit_due = True  # Slicer has yet to place the new view
        self._show_problem()

    def say(self, text: str, done: bool = False) -> None:
        """A message that stays until the next one. done: that something worked, and is no problem."""
        self._message = text
        self.ui.problemLabel.setStyleSheet(DONE_STYLE if done else PROBLEM_STYLE)
        self._show_problem()
        slicer.util.showStatusMessage(text)  # where the panel is scrolled down the label is not seen

    def show_views(self) -> None:
        if slicer.app.layoutManager() is not None:
            if self._parameter_node is not None:
                self.layout.show_mri(self._parameter_node.mriVolume)
            self.controller.views = self.layout.enter()

    def fit(self) -> None:
        self.controller.fit_views()

    def toggle(self) -> None:
        if self.controller.running:
            self.stop()
        else:
            self.start()

    def start(self, single: bool = False) -> bool:
        """Start what is chosen. False, and the reason in the panel, when it cannot be; also later, once it is read."""
        self.say("")
        try:
            self.controller.start(self.source.choice(), single)
        except ExpectedAppearancesError as error:
            self.say(str(error))
            return False
        self._starting = True
        self._parameter_node.browser = None
        self.refresh()
        self.tick()
        return True

    def _started(self, problem: str) -> None:
        """What was chosen has been read, or could not be."""
        self._starting = False
        if problem:
            self.say(problem)
        elif self.controller.running:
            self._show_scan()
        self.refresh()

    def _show_scan(self) -> None:
        """The MRI that the case was planned on, unless another one is chosen."""
        p = self._parameter_node
        try:
            scan = scan_to_show(slicer.mrmlScene, self.controller.case, p.mriVolume)
        except ExpectedAppearancesError as error:  # registration does without
            self.say(str(error))
            return
        if scan is not p.mriVolume:
            p.mriVolume = scan

    def stop(self) -> None:
        self.controller.stop()
        self.align.close()
        self.refresh()
        self.tick_now()

    def freeze(self, checked: bool) -> None:
        if checked:
            self.controller.freeze()
        else:
            self.controller.resume()

    def single(self) -> None:
        if self.controller.running:
            self.controller.next_frame()
        else:
            self.start(single=True)

    def install(self) -> None:
        if dependencies.is_installing():
            return
        with dependencies.installing():
            live_install.install(self.say)
        self.refresh()

    def tick_now(self) -> None:
        """Show what has just changed; while nothing runs, the next tick that does so may be far."""
        self._ticks = -1
        self.tick()

    def tick(self) -> None:
        """Called by the timer, on the GUI thread; short, whatever the session does."""
        if self._fit_due:
            self._fit_due = False
            self.fit()
        running = self.controller.running
        self._ticks += 1
        if not running and self._ticks % IDLE_TICKS:
            return
        # Picture, overlay and what is said over them are drawn together, or not yet.
        with self.controller.drawing_held():
            can = self._show()
        ui = self.ui
        for widget, enabled in (
            (ui.startButton, can.start or can.stop),
            (ui.freezeButton, can.freeze),
            (ui.singleButton, can.single),
        ):
            if widget.enabled != enabled:
                widget.enabled = enabled
        if ui.freezeButton.checked != self.controller.frozen:
            ui.freezeButton.checked = self.controller.frozen
        if self._buttons != (running, self.controller.frozen):
            self._buttons = (running, self.controller.frozen)
            set_text(ui.startButton, _("Stop") if running else _("Start"))
            set_text(ui.singleButton, _("Next frame") if all(self._buttons) else _("Single frame"))

    def _show(self) -> Controls:
        """Bring views and sections up to date; returns what the user can do now."""
        status = self.controller.tick(WAIT_S)
        if self._starting and not self.controller.loading:
            self._started(status.problem)
        has_frame = status.result is not None and status.result.image_rgb is not None
        can = controls(
            not self._problem,
            self.controller.running,
            self.controller.frozen,
            has_frame,
            self.controller.alignment is not None,
            self.controller.recorder is not None,
        )
        self._remember_camera()
        replayed = self.record.show(can.record and has_frame)
        self.align.show(can.align)
        status = replayed or status
        self.status.show(status)
        self.layout.show(status)
        return can

    def _remember_camera(self) -> None:
        """A of the frame on the screen, in the parameter node: a scene does not save a view's window centre."""
        camera, p = self.controller.camera, self._parameter_node
        if camera is None or camera == self._camera or p is None:
            return
        self._camera = camera
        p.cameraJson = json.dumps(camera.to_dict())

    def _show_problem(self) -> None:
        text = self._message or ("" if self.controller.running else self._problem)
        if self.ui.problemLabel.text != text:
            self.ui.problemLabel.text = text
            self.ui.problemLabel.visible = bool(text)
