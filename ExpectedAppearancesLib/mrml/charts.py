"""Tables and plots in the scene: the loss while a model is trained, and its figures of merit when it is.

Nodes are found again by an attribute, so that drawing a plot anew, even in a scene that was saved, adds none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from ..evaluation.verdict import PROTOCOL_NAMES, Figures

ROLE_ATTRIBUTE = "ExpectedAppearances.Role"
LOSS_COLOUR, ADD_COLOUR = (0.35, 0.35, 0.35), (0.05, 0.45, 0.75)
BAR_COLOURS = ((0.05, 0.45, 0.75), (0.85, 0.55, 0.15), (0.4, 0.6, 0.35))
FIGURE_COLUMNS = (  # first those that the verdict rests on
    ("Accepted (%)", "accepted", 100.0),
    ("ADD mean of accepted (mm)", "accepted_add_mm", 1.0),
    ("Accepted below 3 mm (%)", "accepted_right", 100.0),
    ("ADD mean (mm)", "add_mm_mean", 1.0),
    ("ADD median (mm)", "add_mm_median", 1.0),
    ("ADD 95th percentile (mm)", "add_mm_p95", 1.0),
    ("Within 3 mm, 3° (%)", "accuracy_3", 100.0),
    ("Within 5 mm, 5° (%)", "accuracy_5", 100.0),
)


def show_training(scene, curve: Sequence[dict]):
    """Validation ADD and loss against the training step; returns the vtkMRMLPlotChartNode.

    curve: [{"step", "loss", "validation_add_mm"}], either figure possibly None. Each is a plot series of its own table,
    since a line has no gaps.
    """
    parts = (
        ("training.add", "Validation ADD (mm)", "validation_add_mm", ADD_COLOUR),
        ("training.loss", "Loss", "loss", LOSS_COLOUR),
    )
    series_nodes = []
    for role, title, key, colour in parts:
        points = [(p["step"], p[key]) for p in curve if p.get(key) is not None and math.isfinite(p[key])]
        table = _node(scene, "vtkMRMLTableNode", f"{role}.table", f"Training: {title}")
        _fill(table, {"Step": [float(x) for x, _ in points], title: [float(y) for _, y in points]})
        series = _node(scene, "vtkMRMLPlotSeriesNode", f"{role}.series", title)
        series.SetAndObserveTableNodeID(table.GetID())
        series.SetXColumnName("Step")
        series.SetYColumnName(title)
        series.SetPlotType(series.PlotTypeScatter)
        series.SetLineStyle(series.LineStyleSolid)
        series.SetMarkerStyle(series.MarkerStyleCircle if len(points) < 40 else series.MarkerStyleNone)
        series.SetColor(*colour)
        if len(points) > 1:  # VTK complains of a shorter line each time it draws, and Slicer shows its sign of an error
            series_nodes.append(series)
    return _chart(scene, "training.chart", "Training", "Training step", "ADD (mm), loss", series_nodes)


def show_figures(scene, rows: Sequence[Figures], limit_mm: float):
    """The validation's figures: (vtkMRMLTableNode of all rows, vtkMRMLPlotChartNode of the mean ADD of what
    was accepted of each style)."""
    table = _node(scene, "vtkMRMLTableNode", "validation.table", "Validation")
    columns: dict[str, list] = {
        "Test": [PROTOCOL_NAMES.get(row.protocol, row.protocol) for row in rows],
        "Texture": [row.style or "all" for row in rows],
    }
    for title, key, factor in FIGURE_COLUMNS:
        values = [getattr(row, key) for row in rows]
        columns[title] = ["" if value is None else f"{factor * value:.2f}" for value in values]
    _fill(table, columns)
    table.SetUseColumnTitleAsColumnHeader(True)

    protocols = list(dict.fromkeys(row.protocol for row in rows))
    series_nodes = []
    for protocol, colour in zip(protocols, BAR_COLOURS):
        shown = [row for row in rows if row.protocol == protocol and row.accepted_add_mm is not None]
        shown = [row for row in shown if row.style] or shown
        title = PROTOCOL_NAMES.get(protocol, protocol)
        data = _node(scene, "vtkMRMLTableNode", f"validation.{protocol}.table", f"Validation: {title}")
        _fill(data, {"Texture": [row.style or "all" for row in shown], title: [row.accepted_add_mm for row in shown]})
        series = _node(scene, "vtkMRMLPlotSeriesNode", f"validation.{protocol}.series", title)
        series.SetAndObserveTableNodeID(data.GetID())
        series.SetPlotType(series.PlotTypeBar)
        series.SetYColumnName(title)
        series.SetLabelColumnName("Texture")
        series.SetColor(*colour)
        series_nodes.append(series)
    title = f"Mean ADD of accepted views (limit {limit_mm:.1f} mm)"
    return table, _chart(scene, "validation.chart", title, "Texture", "ADD (mm)", series_nodes)


def chart_of(scene, role: str):
    """The chart drawn earlier under `role` ('training.chart', 'validation.chart'), or None."""
    return _find(scene, "vtkMRMLPlotChartNode", role)


def table_of(scene):
    """The table of the validation's figures drawn earlier, or None."""
    return _find(scene, "vtkMRMLTableNode", "validation.table")


def _chart(scene, role: str, title: str, x_title: str, y_title: str, series_nodes: list):
    chart = _node(scene, "vtkMRMLPlotChartNode", role, title)
    chart.SetTitle(title)
    chart.SetXAxisTitle(x_title)
    chart.SetYAxisTitle(y_title)
    wanted = [series.GetID() for series in series_nodes]
    present = [chart.GetNthPlotSeriesNodeID(i) for i in range(chart.GetNumberOfPlotSeriesNodes())]
    if present != wanted:
        chart.RemoveAllPlotSeriesNodeIDs()
        for identifier in wanted:
            chart.AddAndObservePlotSeriesNodeID(identifier)
    return chart


def _fill(table_node, columns: dict[str, list]) -> None:
    """Replace the table's content at once; a column is text where a value of it is, else double."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk

    table = vtk.vtkTable()
    for title, values in columns.items():
        if any(isinstance(value, str) for value in values):
            column = vtk.vtkStringArray()
            for value in values:
                column.InsertNextValue(value)
        else:
            column = numpy_to_vtk(np.array(values, float), deep=True)
        column.SetName(title)
        table.AddColumn(column)
    table_node.SetAndObserveTable(table)


def _node(scene, kind: str, role: str, name: str):
    node = _find(scene, kind, role)
    if node is None:
        node = scene.AddNewNodeByClass(kind, name)
        node.SetAttribute(ROLE_ATTRIBUTE, role)
    return node


def _find(scene, kind: str, role: str):
    for i in range(scene.GetNumberOfNodesByClass(kind)):
        node = scene.GetNthNodeByClass(i, kind)
        if node.GetAttribute(ROLE_ATTRIBUTE) == role:
            return node
    return None
