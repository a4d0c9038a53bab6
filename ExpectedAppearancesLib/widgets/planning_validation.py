"""Section Validation: the figures of merit as a table and a plot, and a verdict against the user's limits."""

from __future__ import annotations

import html

import slicer
from slicer.i18n import tr as _

from ..evaluation.verdict import PROTOCOL_NAMES
from ..mrml import charts
from .planning_qt import allow
from .planning_section import Section

READY_COLOUR, NOT_READY_COLOUR = "#3c9a4e", "#c2452d"


class ValidationSection(Section):
    name = "validation"
    title = "Validation"

    def setup(self) -> None:
        self.ui.showFiguresButton.connect("clicked(bool)", lambda _checked=False: self.on_show())

    def refresh(self) -> None:
        rows = self._rows()
        allow(
            self.ui.showFiguresButton,
            "" if rows else _("Train the model first: there are no figures yet."),
            _("Show the table of figures, and the plot of the mean ADD of each texture."),
        )
        self.ui.verdictLabel.visible = bool(rows)
        if rows:
            self.ui.verdictLabel.text = self._verdict(rows)

    def on_show(self) -> None:
        rows = self._rows()
        if not rows:
            return
        table, chart = charts.show_figures(self.panel.scene, rows, self.parameters.addLimitMm)
        if slicer.app.layoutManager():
            slicer.app.layoutManager().setLayout(slicer.vtkMRMLLayoutNode.SlicerLayoutFourUpPlotTableView)
        slicer.modules.plots.logic().ShowChartInLayout(chart)
        selection = slicer.app.applicationLogic().GetSelectionNode()
        selection.SetActiveTableID(table.GetID())
        slicer.app.applicationLogic().PropagateTableSelection()

    def _rows(self) -> list:
        case = self.session.case(self.parameters)
        return self.session.reader.figures(case)[0] if case else []

    def _verdict(self, rows: list) -> str:
        ready, reasons = self.panel.recorded.verdict
        shown = next(row for row in rows if not row.style)
        head = _("Ready") if ready else _("Not ready")
        colour = READY_COLOUR if ready else NOT_READY_COLOUR
        lines = [f'<b style="color:{colour}">{head}</b>']
        lines += [f"– {html.escape(reason)}" for reason in reasons]
        lines.append(
            _("Measured on: {protocol}.").format(protocol=_(PROTOCOL_NAMES.get(shown.protocol, shown.protocol)))
        )
        return "<br>".join(lines)
