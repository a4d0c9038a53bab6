"""Accuracy-threshold curves and per-style bars, as PNG."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .. import files
from .metrics import ADD_RANGE_MM, FrameErrors, accuracy, add_accuracy, add_auc

LONGEST_NAME = 40  # characters beside the bars
_ALL, _ACCEPTED, _STYLE, _SECOND = "#1f4e99", "#2a9d5c", "#9aa5b1", "#e08a2e"


def curve_points(errors: FrameErrors, step: float = 1) -> dict[str, list[float]]:
    """Shares at the limits n = 0, step ... 20: 'limits', 'n mm-n deg' and 'add'."""
    limits = np.arange(round(ADD_RANGE_MM / step) + 1) * step
    return {
        "limits": limits.tolist(),
        "n mm-n deg": [accuracy(errors, n) for n in limits],
        "add": [add_accuracy(errors, n) for n in limits],
    }


def write_curves(path: Path, errors: FrameErrors, styles: Sequence[str | None]) -> None:
    """Two panels: share within n mm and n degrees, and share with ADD below n mm; thin lines are the styles."""
    figure = new_figure(10, 4.4)
    limits = np.linspace(0, ADD_RANGE_MM, 201)
    labels = np.array([style or "" for style in styles], object)
    panels = (
        (accuracy, "Within n mm and n degrees", "n, mm and degrees"),
        (add_accuracy, "ADD below n mm", "n, mm"),
    )
    for axes, (share, title, x_label) in zip(figure.subplots(1, 2, sharey=True), panels):
        names = sorted(set(labels))
        for i, name in enumerate(names if len(names) > 1 else ()):
            of_style = errors.select(labels == name)
            label = "each style" if i == 0 else None
            axes.plot(limits, [100 * share(of_style, n) for n in limits], color=_STYLE, lw=0.8, label=label)
        accepted = errors.select(errors.accepted)
        axes.plot(limits, [100 * share(errors, n) for n in limits], color=_ALL, lw=2.2, label="all frames")
        if 0 < len(accepted) < len(errors):
            values = [100 * share(accepted, n) for n in limits]
            axes.plot(limits, values, color=_ACCEPTED, lw=1.8, ls="--", label=f"{len(accepted)} accepted frames")
        axes.set(title=title, xlabel=x_label, xlim=(0, ADD_RANGE_MM), ylim=(0, 102))
        axes.set_xticks(range(0, int(ADD_RANGE_MM) + 1, 2))
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", frameon=False)
    figure.axes[0].set_ylabel("share of frames, %")
    figure.axes[1].text(0.97, 0.35, f"AUC {add_auc(errors):.3f}", transform=figure.axes[1].transAxes, ha="right")
    write_figure(path, figure)


def write_reliability(path: Path, reliabilities: Mapping[str, Mapping]) -> None:
    """Reliability diagram: share of frames with ADD below 3 mm against confidence, a line for each label; a mark's area
    is the number of its frames. Values as `metrics.reliability` gives them."""
    figure = new_figure(5.6, 5.0)
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color=_STYLE, lw=0.8)
    for label, values in reliabilities.items():
        rows, total = values["bins"], sum(row["frames"] for row in values["bins"])
        x, y = ([100 * row[key] for row in rows] for key in ("confidence", "add_below_3mm"))
        name = f"{label + ', ' if label else ''}calibration error {values['expected_calibration_error']:.3f}"
        (line,) = axes.plot(x, y, lw=1.2, label=name, **({} if len(reliabilities) > 1 else {"color": _ALL}))
        axes.scatter(x, y, [8 + 400 * row["frames"] / total for row in rows], color=line.get_color(), alpha=0.7)
    axes.set(xlabel="confidence, %", ylabel="frames with ADD below 3 mm, %", xlim=(-3, 103), ylim=(-3, 103))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", frameon=False, fontsize=8)
    write_figure(path, figure)


def write_style_bars(path: Path, metrics: dict) -> None:
    """Bars for each style of `metrics.metrics`: ADD mean and median, and the share within 3 mm-3 deg and 5 mm-5 deg."""
    styles = metrics["styles"]
    figure = new_figure(10, 1.6 + 0.34 * len(styles))
    left, right = figure.subplots(1, 2, sharey=True)
    rows = np.arange(len(styles))
    panels = (
        (left, "ADD, mm", 1, [("mean", _ALL, ("add_mm", "mean")), ("median", _STYLE, ("add_mm", "median"))]),
        (right, "share of frames, %", 100, [(k, c, ("accuracy", k)) for k, c in _accuracy_bars(metrics)]),
    )
    for axes, x_label, scale, bars in panels:
        for offset, (name, colour, (group, key)) in zip((-0.2, 0.2), bars):
            values = [figures[group][key] for figures in styles.values()]
            drawn = axes.barh(rows + offset, [scale * (v or 0) for v in values], 0.38, color=colour, label=name)
            # Where no frame has a pose there is no ADD, and 0 would be the best there is.
            shown = ["no pose" if v is None else f"{scale * v:.{2 if scale == 1 else 0}f}" for v in values]
            axes.bar_label(drawn, shown, padding=2, fontsize=7)
        axes.set(xlabel=x_label, xlim=(0, 112 if scale == 100 else axes.get_xlim()[1] * 1.1))
        axes.grid(axis="x", alpha=0.3)
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    # A style is any text of a poses.json.
    left.set_yticks(rows, [name if len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 1]}…" for name in styles])
    left.set_ylabel("style")
    left.invert_yaxis()
    write_figure(path, figure)


def _accuracy_bars(metrics: dict) -> list[tuple[str, str]]:
    return list(zip(metrics["accuracy"], (_ALL, _SECOND)))


def new_figure(width_inch: float, height_inch: float):
    # The object interface: pyplot keeps global state and may want a display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((width_inch, height_inch), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def write_figure(path: Path, figure) -> None:
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        text.set_parse_math(False)  # names of textures and folders may hold dollar signs
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    files.write_bytes(path, buffer.getvalue())
