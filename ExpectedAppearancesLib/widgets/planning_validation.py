"""Section Validation: a study in a process of its own, its figures as table and plot, a verdict against limits."""

from __future__ import annotations

import html

import slicer
from slicer.i18n import tr as _

from ..evaluation.verdict import PROTOCOL_NAMES, deciding
from ..gpus import device_arguments
from ..mrml import charts
from ..planning.steps import StepState, Study, changes_of_training
from .planning_qt import allow
from .planning_run import RunControls, in_the_way, started
from .planning_section import Section
from .refreshing import set_text

STUDY_TEXTS = {"start": "Start the study", "continue": "Continue the study", "again": "Make the study again"}
LEAST_TEXTURES = 2
READY_COLOUR, NOT_READY_COLOUR = "#3c9a4e", "#c2452d"


class ValidationSection(Section):
    name = "validation"
    title = "Validation"

    def setup(self) -> None:
        ui = self.ui
        self._shown: tuple | None = None  # rows and limit of table and plot as they are in the scene
        self.controls = RunControls(
            self.panel.runs["study"],
            ui.studyStart,
            ui.studyCancel,
            ui.studyProgress,
            ui.studyLine,
            _("Train a model without each texture, and test it on views of that texture. The case's model stays."),
            STUDY_TEXTS,
        )
        ui.studyStart.connect("clicked(bool)", lambda _checked=False: self.on_start())
        ui.studyCancel.connect("clicked(bool)", lambda _checked=False: self.controls.watch.cancel())
        ui.showFiguresButton.connect("clicked(bool)", lambda _checked=False: self.on_show())

    def refresh(self) -> None:
        rows = self._rows()
        recorded = self.panel.recorded
        textures = {item["style"] for item in recorded.index["items"]} if recorded.index else set()
        problem, study = self._problem(len(textures)), recorded.study
        self.controls.refresh(problem, study is Study.STOPPED, study is Study.DONE, self.step.text)
        self._show_hint(len(textures))
        allow(
            self.ui.showFiguresButton,
            "" if rows else _("There are no figures yet: train the model, or start a study."),
            _("Show the table of figures, and the plot of the mean ADD of accepted views of each texture."),
        )
        other = (rows, self.parameters.acceptedAddLimitMm) != self._shown and (rows or self._shown)
        if other and charts.table_of(self.panel.scene):
            self._fill(rows)  # it was shown before, and there are newer figures, or those of another case
        self.ui.verdictLabel.visible = bool(rows)
        if rows:
            self.ui.verdictLabel.text = self._verdict(rows)

    def on_show(self) -> None:
        rows = self._rows()
        if not rows:
            return
        table, chart = self._fill(rows)
        if slicer.app.layoutManager():
            slicer.app.layoutManager().setLayout(slicer.vtkMRMLLayoutNode.SlicerLayoutFourUpPlotTableView)
        slicer.modules.plots.logic().ShowChartInLayout(chart)
        selection = slicer.app.applicationLogic().GetSelectionNode()
        selection.SetActiveTableID(table.GetID())
        slicer.app.applicationLogic().PropagateTableSelection()

    def close(self) -> None:
        self._shown = None

    def on_start(self) -> None:
        started(self.panel, self.controls.watch, *self.arguments())

    def arguments(self) -> tuple[list[str], dict[str, str]]:
        """Options of the command `study`, and what its environment needs: models like the one that is trained."""
        p = self.parameters
        device, environment = device_arguments(self.panel.sections["training"].device)
        options = ["--protocols", p.studyProtocols.value, "--preset", p.preset.value, "--minutes", f"{p.minutes:g}"]
        return [*options, "--appearances", p.method.value, *device], environment

    def _problem(self, textures: int) -> str:
        """Why no study can begin, '' if nothing is in the way."""
        before = self.panel.steps["appearances"]
        problem = in_the_way(self.panel, "study")
        if not problem and before.state is not StepState.DONE:
            problem = self.reason_of("appearances")
        if not problem and textures < LEAST_TEXTURES:
            problem = _("A study leaves one texture out: make expected appearances of at least 2 textures.")
        return problem or self.panel.help.reason("training")

    def _show_hint(self, textures: int) -> None:
        """How much work it is."""
        p = self.parameters
        models = textures * len(p.studyProtocols.value.split(","))
        text = _(
            "Trains {models} models as set above: {time} of training, and some minutes more to test each of them."
        ).format(models=models, time=_duration(models * p.minutes))
        recorded = self.panel.recorded
        if recorded.study is Study.STOPPED and changes_of_training(p.preset.value, p.minutes, recorded.study_preset):
            text += " " + _("The study that was stopped had other settings: it begins anew, its models are not used.")
        set_text(self.ui.studyHint, text if models else "")

    def _fill(self, rows: list) -> tuple:
        """Table and chart in the scene, with these figures."""
        self._shown = (rows, self.parameters.acceptedAddLimitMm)
        return charts.show_figures(self.panel.scene, *self._shown)

    def _rows(self) -> list:
        case = self.session.case(self.parameters)
        return self.session.reader.figures(case)[0] if case else []

    def _verdict(self, rows: list) -> str:
        ready, reasons = self.panel.recorded.verdict
        shown = deciding(rows)
        head = _("Ready") if ready else _("Not ready")
        colour = READY_COLOUR if ready else NOT_READY_COLOUR
        if self.panel.recorded.validation == "stale":
            head, colour = _("Outdated: make the study again"), NOT_READY_COLOUR
        lines = [f'<b style="color:{colour}">{head}</b>']
        lines += [f"– {html.escape(reason)}" for reason in reasons]
        lines.append(
            _("Measured on: {protocol}.").format(protocol=_(PROTOCOL_NAMES.get(shown.protocol, shown.protocol)))
        )
        return "<br>".join(lines)


def _duration(minutes: float) -> str:
    if minutes < 90:
        return _("{minutes:.0f} min").format(minutes=max(minutes, 1))
    return _("{hours:.1f} hours").format(hours=minutes / 60)
