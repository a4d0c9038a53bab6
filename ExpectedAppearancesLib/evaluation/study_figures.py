"""Pictures of a study, as PNG, from the content of study.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from .curves import new_figure, write_figure
from .metrics import ADD_RANGE_MM

COLOURS = ("#1f4e99", "#e08a2e", "#2a9d5c", "#a23b72", "#6c757d", "#0096b4", "#8d6a00", "#c0392b")


def write_study_curves(path: Path, thresholds: Mapping[str, Mapping]) -> None:
    """Accuracy-threshold curves 0-20 mm, one line for each label; AUC of the right panel in its legend."""
    figure = new_figure(11, 4.6)
    panels = (("n mm-n deg", "Within n mm and n degrees", "n, mm and degrees"), ("add", "ADD below n mm", "n, mm"))
    for axes, (key, title, x_label) in zip(figure.subplots(1, 2, sharey=True), panels):
        for i, (label, points) in enumerate(thresholds.items()):
            auc = f", AUC {points['add_auc_20mm']:.3f}" if key == "add" else ""
            shares = 100 * np.array(points[key], float)
            axes.plot(points["limits"], shares, color=COLOURS[i % len(COLOURS)], lw=1.8, label=label + auc)
        axes.set(title=title, xlabel=x_label, xlim=(0, ADD_RANGE_MM), ylim=(0, 102))
        axes.set_xticks(range(0, int(ADD_RANGE_MM) + 1, 2))
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right", frameon=False, fontsize=8)
    figure.axes[0].set_ylabel("share of frames, %")
    write_figure(path, figure)


def write_texture_bars(path: Path, per_style: Mapping[str, Mapping[str, Mapping]]) -> None:
    """Mean ADD on each left-out texture, one bar for each label: per_style[label][style] = metrics."""
    styles = sorted({style for figures in per_style.values() for style in figures})
    figure = new_figure(min(14, max(7, 1.5 + len(styles) * max(0.6, 0.16 * len(per_style)))), 4.2)
    axes = figure.subplots()
    width = 0.82 / len(per_style)
    for i, (label, figures) in enumerate(per_style.items()):
        heights = [_add_mean(figures.get(style)) for style in styles]
        places = np.arange(len(styles)) + (i - (len(per_style) - 1) / 2) * width
        bars = axes.bar(places, heights, 0.94 * width, color=COLOURS[i % len(COLOURS)], label=label)
        if len(per_style) <= 3:
            axes.bar_label(bars, ["" if np.isnan(h) else f"{h:.1f}" for h in heights], fontsize=7, padding=1)
    axes.set_xticks(range(len(styles)), styles)
    axes.set(xlabel="left-out texture", ylabel="ADD mean, mm", xlim=(-0.6, len(styles) - 0.4))
    axes.grid(axis="y", alpha=0.3)
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1.0), ncols=3, frameon=False, fontsize=8)
    write_figure(path, figure)


def write_texture_counts(path: Path, studies: Mapping[str, Sequence[Mapping]]) -> None:
    """Mean ADD and 3mm-3deg against the number of training textures; one line for each label (case)."""
    figure = new_figure(10, 3.8)
    left, right = figure.subplots(1, 2)
    for i, (label, rows) in enumerate(studies.items()):
        counts, colour = [row["textures"] for row in rows], COLOURS[i % len(COLOURS)]
        left.plot(counts, [_add_mean(row["metrics"]) for row in rows], "o-", color=colour, label=label)
        shares = [100 * row["metrics"]["accuracy"]["3mm-3deg"] for row in rows]
        right.plot(counts, shares, "o-", color=colour, label=label)
    for axes, name in ((left, "ADD mean, mm"), (right, "within 3 mm and 3 degrees, %")):
        axes.set(xlabel="training textures", ylabel=name)
        axes.set_ylim(0, 1.05 * axes.get_ylim()[1])
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.grid(alpha=0.3)
    if len(studies) > 1:
        left.legend(frameon=False)
    write_figure(path, figure)


def _add_mean(metrics: Mapping | None) -> float:
    value = None if metrics is None else metrics["add_mm"]["mean"]
    return float("nan") if value is None else float(value)
