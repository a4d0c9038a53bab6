"""The planning panel: its sections, what they share, and what becomes of it all when something is closed."""

from __future__ import annotations

import html
import logging
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import qt
import slicer
from slicer.i18n import tr as _

from ..mrml import planning
from ..mrml.planning_adopt import adopting
from ..mrml.planning_session import PlanningSession
from ..mrml.segment_surface import SegmentSurfaces
from ..planning.recorded import Recorded
from ..planning.steps import STEPS, Step, StepState, next_step
from ..runs.closing import OnClose, close_runs, going_on, question
from ..runs.runner import loaded_for_runs
from ..runs.state import RunState, RunStatus
from .planning_appearances import AppearancesSection
from .planning_case import CaseSection, MicroscopeSection
from .planning_help import HelpSection
from .planning_poses import PosesSection
from .planning_qt import Asking, Stepper, single_shot
from .planning_run import RunWatch
from .planning_section import changed
from .planning_textures import TexturesSection
from .planning_training import TrainingSection
from .planning_validation import ValidationSection
from .refreshing import quiet

REFRESH_MS = 30
OPENING = "The case is being opened."
SECTIONS = (
    CaseSection,
    MicroscopeSection,
    PosesSection,
    TexturesSection,
    AppearancesSection,
    TrainingSection,
    ValidationSection,
)
SELECTORS = ("vesselsSelector", "cortexSelector", "mriSelector", "craniotomySelector")
SECTION_OF_KIND = {"render": "poses", "synthesize": "appearances", "train": "training", "study": "validation"}


class PlanningPanel:
    """ui: the widgets of the .ui by name. session: what is worked on. scene: Slicer's."""

    def __init__(self, ui, session: PlanningSession, scene):
        self.ui, self.session, self.scene = ui, session, scene
        self.parameters = None
        self.entered = self.loading = False
        self.steps: dict[str, Step] = {name: Step(StepState.MISSING, "") for name in STEPS}
        self.recorded = Recorded()
        self._followed: str | None = None
        self._next = ""
        self._timer = single_shot(REFRESH_MS, self._refresh_in_pieces)
        self._stepper = Stepper()
        self._opening, self.opening = Stepper(), False  # whether a case is being opened
        self._writing = Stepper()  # a segment whose surface is asked for
        self._folder = tempfile.TemporaryDirectory(prefix="expected-appearances-")
        self._surfaces = Asking("surfaces", self._on_surface, urgent=True)
        session.surfaces = SegmentSurfaces(self._surfaces.ask)
        self._left: list = []  # runs of cases that were open before this one
        self._ending: list = []  # runs of cases that are no longer open, on their way to their end
        self._ending_timer = qt.QTimer()
        self._ending_timer.setInterval(500)
        self._ending_timer.connect("timeout()", self._poll_ending)
        self.runs = {kind: RunWatch(kind, lambda status, k=kind: self._on_run(k, status)) for kind in SECTION_OF_KIND}
        self.help = HelpSection(self)
        self.sections = {section.name: section(self) for section in SECTIONS}

    def set_parameters(self, parameters, connect: Callable[[], None]) -> None:
        """Show these parameters, or none; `connect` binds them to the widgets, which must not answer meanwhile."""
        self.parameters = parameters
        if parameters is None:
            self._opening.stop()
            self._timer.stop()
            self._stepper.stop()
            return
        self.loading = True
        try:
            with quiet(self.ui.vesselsSelector, self.ui.craniotomySelector):
                connect()
        finally:
            self.loading = False
        self.refresh_soon()

    def enter(self) -> None:
        self.entered = True
        self.sections["training"].enter()
        self.help.enter()
        self.refresh()
        # Back from the Segment Editor: there a photograph is still to be saved.
        self.unfold("textures" if self.sections["textures"].labelling.nodes else self._next)

    def exit(self) -> None:
        self.entered = False
        for section in self.sections.values():
            section.leave()

    def cleanup(self) -> None:
        """The widget is destroyed: runs go on and are found again by the next panel."""
        self.exit()
        self._timer.stop()
        self._stepper.stop()
        self._opening.stop()
        self._forget_surface()
        self._folder.cleanup()
        self._ending_timer.stop()
        for watch in self.runs.values():
            watch.forget()
        for section in self.sections.values():
            section.close()
        self.help.close()

    def let_go(self, node) -> None:
        """Before a node is removed: Slicer's selectors would choose another in its place, the cortex as vessels."""
        for selector in (getattr(self.ui, name) for name in SELECTORS):
            if selector.currentNode() == node:
                selector.setCurrentNode(None)

    def refresh_soon(self) -> None:
        """Refresh once after a burst of changes."""
        if self.parameters is not None and not self.opening:
            self._timer.start()

    def refresh(self) -> None:
        """Work out the steps and show them, at once. `refresh_soon` does it between the events of the GUI."""
        self._timer.stop()
        self._stepper.stop()
        if self.parameters is None or self.opening:
            return
        if self._followed != self.parameters.casePath:
            self._followed = self.parameters.casePath
            self.sections["training"].forget_run()
            left = [run for run in self._going_on() if run.case_folder != Path(self._followed)]
            self._left = self._not_cancelled(left)
            for watch in self.runs.values():
                watch.follow(self._followed)
        if not self.entered:
            return
        self.recorded = self.session.recorded(self.parameters)
        if self.recorded.manifest:
            changed(self.parameters, "savedCasePath", self.parameters.casePath)
        self.steps = self.session.steps(self.parameters, self.running(), self.recorded)
        for section in self.sections.values():
            section.refresh()
            section.show_step()
        self.help.refresh()
        self._show_next()
        if not self._writing.working and self.session.surfaces.to_ask(*self._segment()):
            self._writing.start(self.session.surfaces.asking(*self._segment(), Path(self._folder.name)))

    def _refresh_in_pieces(self) -> None:
        """What is large is looked at piece by piece, so that no call takes long."""

        def pieces():
            if self.entered:
                yield from self.session.prepare(self.parameters)
                yield from loaded_for_runs()
            self.refresh()  # the last: it stops what is still to be done

        self._stepper.start(pieces())

    def running(self) -> frozenset[str]:
        return frozenset(kind for kind, watch in self.runs.items() if watch.active)

    def _going_on(self) -> list:
        """Runs of this case, and of those that were open before in this scene."""
        return going_on([*(watch.run for watch in self.runs.values()), *self._left])

    def busy(self) -> bool:
        """Whether something works on the case, which must then not be replaced."""
        return bool(self.running()) or self.sections["case"].saving

    def _segment(self) -> tuple:
        return self.parameters.vesselsNode, self.parameters.vesselsSegmentId

    def _on_surface(self, question: dict, answer: dict) -> None:
        if "failed" in answer:
            logging.warning("Expected Appearances: %s The surface is made here.", answer["failed"])
        self.session.surfaces.take(question, answer)
        self.refresh_soon()

    def _forget_surface(self) -> None:
        self._writing.stop()
        self._surfaces.stop()
        self.session.surfaces.forget()

    def open_folder(self, folder: str, take_over: bool = False) -> None:
        """Make `folder` the case; with take_over its models and settings replace what is chosen, a piece at a time."""
        self._timer.stop()
        self._stepper.stop()
        self._followed = None  # also the same folder may hold another case now
        if take_over:
            self._opening.stop()
            pieces = self._open_in_pieces(folder)
            next(pieces)  # so that it is said at once
            self._opening.start(pieces)
            return
        self.parameters.casePath, self.parameters.savedCasePath = folder, ""
        self.refresh()
        self.unfold(self._next)

    def _open_in_pieces(self, folder: str) -> Iterator[None]:
        """Nothing can be changed in the panel meanwhile."""
        widgets = [section.button for section in self.sections.values()]
        before, self.opening = self.ui.nextLabel.text, True
        scan_before = self.parameters.mriVolume
        self.sections["poses"].leave()  # what the slice view showed before it was looked through is that of this case
        try:
            for widget in widgets:
                widget.enabled = False
            self.ui.nextLabel.text = _(OPENING)
            yield
            yield from loaded_for_runs()  # the refresh below would load them in one call
            with slicer.util.tryWithErrorDisplay(_("The case could not be opened.")):
                case = yield from self._adopting(folder)
                if case is None:
                    slicer.util.errorDisplay(self.session.recorded(self.parameters).problem)
                else:
                    yield from self._look_at_case()
        finally:
            for widget in widgets:
                widget.enabled = True
            self.ui.nextLabel.text, self.opening = before, False
            self.refresh_soon()  # what is displayed as an error ends this, too
        self.refresh()
        yield
        yield from self.sections["case"].showing_scan(scan_before)
        self.unfold(self._next)

    def _adopting(self, folder: str) -> Iterator[None]:
        """The panel's widgets take over what they are told and answer to nothing."""
        pieces = adopting(self.session, self.parameters, folder, self.scene, slicer.util.warningDisplay)
        try:
            while True:
                self.loading = True
                try:
                    next(pieces)
                except StopIteration as stop:
                    return stop.value
                finally:
                    self.loading = False
                yield
        finally:
            pieces.close()

    def _look_at_case(self) -> Iterator[None]:
        """Turn the first 3D view to where the surgeon looks from: edge-on a cortex shows nothing."""
        manager = slicer.app.layoutManager()
        if manager is None or not manager.threeDViewCount:
            return
        widget = manager.threeDWidget(0)
        camera_node = slicer.modules.cameras.logic().GetViewActiveCameraNode(widget.mrmlViewNode())
        if camera_node is not None:
            craniotomy = self.session.craniotomy(self.parameters)
            yield
            planning.look_onto(camera_node, craniotomy, self.session.space(self.parameters))
        yield
        widget.threeDView().resetFocalPoint()
        widget.threeDView().resetCamera(False, True, True)

    def unfold(self, name: str) -> None:
        """Open the section of one step and close the others."""
        for section in self.sections.values():
            section.button.collapsed = section.name != name

    def closing_scene(self) -> None:
        """Before the scene is closed: runs end or go on as the user chose, and every node is let go."""
        active, self._left = self._not_cancelled(self._going_on()), []
        if active and self._choice(active) is OnClose.END:
            self._end(active)
        for watch in self.runs.values():
            watch.forget()
        self._followed = None
        self._opening.stop()
        self._forget_surface()
        for section in self.sections.values():
            section.leave()
            section.close()

    def quitting(self) -> None:
        """Slicer ends: nobody can be asked any more, so what is not to be ended goes on."""
        if self.parameters is not None:
            close_runs(self._going_on() + self._ending, OnClose(self.parameters.whenClosing.value))

    def _choice(self, active: list) -> OnClose:
        choice = OnClose(self.parameters.whenClosing.value) if self.parameters else OnClose.DETACH
        if choice is not OnClose.ASK or slicer.app.testingEnabled():
            return choice
        goes_on = slicer.util.confirmYesNoDisplay(question(active), windowTitle=_("Let it go on?"))
        return OnClose.DETACH if goes_on else OnClose.END

    def _not_cancelled(self, runs: list) -> list:
        """Those that can go on by themselves; it is seen to that the others end."""
        cancelled = [run for run in runs if run.poll().state is RunState.CANCELLING]
        self._end(cancelled)
        return [run for run in runs if run not in cancelled]

    def _end(self, runs: list) -> None:
        for run in runs:
            run.cancel()
        self._ending += runs
        self._ending_timer.start()

    def _poll_ending(self) -> None:
        self._ending = going_on(self._ending)
        if not self._ending:
            self._ending_timer.stop()

    def _on_run(self, kind: str, status: RunStatus) -> None:
        if kind == "train":
            self.sections["training"].on_status(status)
        if not status.state.active:
            logging.info("Expected Appearances: %s is %s. %s", kind, status.state.value, status.problem)
        if status.state is RunState.DONE and self.entered:
            self.refresh()
            self._go_on_from(SECTION_OF_KIND[kind])
            if kind == "study":
                self.sections["validation"].on_show()
        self.refresh_soon()

    def _show_next(self) -> None:
        name = next_step(self.steps)
        step = self.steps[name]
        title = html.escape(_(self.sections[name].title))
        if all(s.state is StepState.DONE for s in self.steps.values()):
            self.ui.nextLabel.text = _("All done: the model is ready.")
        else:
            self.ui.nextLabel.text = f"<b>{_('Next')}: {title}.</b> {html.escape(step.text)}"
        self._next = name

    def _go_on_from(self, finished: str) -> None:
        """A run has finished a step that the user is looking at: open the next one."""
        if self.steps[finished].state is StepState.DONE and not self.sections[finished].button.collapsed:
            self.sections[self._next].button.collapsed = False
            # Appearances and loss are worth seeing; label maps were looked at before.
            self.sections[finished].button.collapsed = finished == "poses"
