"""One HTML file that holds the whole evaluation, figures embedded, to be read or sent without anything beside it."""

from __future__ import annotations

import base64
import datetime
from pathlib import Path

from .. import __version__, files

# (heading, unit, path of keys in metrics.json, factor, digits)
COLUMNS = (
    ("frames", "", ("frames",), 1, 0),
    ("refused", "", ("refused",), 1, 0),
    ("ADD mean", "mm", ("add_mm", "mean"), 1, 2),
    ("median", "mm", ("add_mm", "median"), 1, 2),
    ("95 %", "mm", ("add_mm", "p95"), 1, 2),
    ("lateral", "mm", ("add_mm", "lateral_mean"), 1, 2),
    ("depth", "mm", ("add_mm", "depth_mean"), 1, 2),
    ("3mm-3deg", "%", ("accuracy", "3mm-3deg"), 100, 1),
    ("5mm-5deg", "%", ("accuracy", "5mm-5deg"), 100, 1),
    ("AUC 20 mm", "", ("add_auc_20mm",), 1, 3),
    ("rotation", "deg", ("rotation_deg",), 1, 2),
    ("translation", "mm", ("translation_mm",), 1, 2),
)

STYLE_SHEET = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1c2733; max-width: 1180px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.5em; margin-bottom: 0; } h2 { font-size: 1.15em; margin-top: 2em; }
.note { color: #5b6876; } .scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3em .7em; text-align: right; border-bottom: 1px solid #e3e8ee; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; }
thead th { border-bottom: 2px solid #9aa5b1; font-weight: 600; }
tr.total td { font-weight: 600; } img { max-width: 100%; height: auto; }
.true { color: #17953a; font-weight: 600; } .predicted { color: #2f62e0; font-weight: 600; }
"""

# In both reports, of one evaluation and of a study.
RELIABILITY_SECTION = """{% if reliability %}<h2>Confidence</h2>
<p>Share of frames with ADD below 3 mm against the confidence they were given; below the diagonal confidence was too
high. The expected calibration error is the mean distance from the diagonal.</p>
<img src="{{ reliability }}" alt="Reliability diagram">{% endif %}"""

_TEMPLATE = (
    """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Registration of {{ case }}</title>
<style>{{ style_sheet }}</style></head><body>
<h1>Registration of {{ case }}</h1>
<p class="note">{{ date }} &middot; ExpectedAppearances {{ version }} &middot;
for research only, not a medical device</p>
<p>{{ headline }}</p>
<h2>Figures</h2>
<div class="scroll"><table><thead><tr><th></th>
{% for name, unit in headings %}<th>{{ name }}{% if unit %}<br>{{ unit }}{% endif %}</th>{% endfor %}</tr></thead>
<tbody>{% for row in rows %}<tr{% if row.total %} class="total"{% endif %}><td>{{ row.name }}</td>
{% for cell in row.cells %}<td>{{ cell }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
<p class="note">ADD: mean over the vessel mesh's vertices of the distance between true and predicted position, in the
camera frame; lateral and depth are its parts across and along the optical axis. n mm-n deg: share of frames with less
than n mm translation error at the mesh centroid and less than n degrees rotation error. AUC: area under the curve of
ADD below 0 to 20 mm. Frames without a pose have no ADD and count as misses in shares and AUC ({{ without_pose }} here);
refused frames that have a pose are in the figures of all frames, and left out of accepted only.</p>
<h2>Accuracy against threshold</h2><img src="{{ curves }}" alt="Accuracy-threshold curves">
{% if by_style %}<h2>Styles</h2><img src="{{ by_style }}" alt="Figures of each style">{% endif %}
"""
    + RELIABILITY_SECTION
    + """
<h2>Overlays</h2>
<p>Outline of the vessels at the <span class="true">true</span> and at the <span class="predicted">predicted</span>
pose, from the smallest error to the largest.</p><img src="{{ overlays }}" alt="Overlays">
</body></html>
"""
)


def write_report(folder: Path, case_name: str, evaluation) -> None:
    """report.html in `folder`, from an evaluate.Evaluation and the PNG files that are there already."""
    import jinja2

    result = evaluation.metrics
    template = jinja2.Environment(autoescape=True, trim_blocks=True).from_string(_TEMPLATE)
    html = template.render(
        style_sheet=STYLE_SHEET,
        case=case_name,
        date=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        version=__version__,
        headline=headline(result),
        headings=[(name, unit) for name, unit, *_ in COLUMNS],
        rows=[{"name": name, "cells": cells(values), "total": total} for name, values, total in _rows(result)],
        without_pose=result["without_pose"],
        curves=embedded(folder / "curves.png"),
        by_style=embedded(folder / "styles.png") if len(result["styles"]) > 1 else "",
        reliability=embedded(folder / "reliability.png") if "reliability" in result else "",
        overlays=embedded_photograph(folder / "overlays.png"),
    )
    files.write_bytes(folder / "report.html", html.encode("utf-8"))


def headline(metrics: dict) -> str:
    """The result in a sentence or two of plain words."""
    frames, add = metrics["frames"], metrics["add_mm"]
    if add["mean"] is None:
        return f"None of the {frames} frames was given a pose."
    text = (
        f"{frames} frames: ADD {add['mean']:.2f} mm on average, median {add['median']:.2f} mm; "
        f"{100 * metrics['accuracy']['3mm-3deg']:.1f} % within 3 mm and 3 degrees, {metrics['refused']} refused."
    )
    if "mean_pose_add_mm" in metrics:
        text += f" Answering the mean pose every time would give {metrics['mean_pose_add_mm']:.2f} mm."
    if "latency_ms" in metrics:
        latency = metrics["latency_ms"]
        text += f" A frame takes {latency['median']:.0f} ms (95 % of them at most {latency['p95']:.0f} ms)."
    return text


def text_table(metrics: dict) -> str:
    """The same table for a terminal."""
    table = [["", *(f"{name}, {unit}" if unit else name for name, unit, *_ in COLUMNS)]]
    table += [[name, *cells(values)] for name, values, _ in _rows(metrics)]
    widths = [max(len(row[i]) for row in table) for i in range(len(table[0]))]
    lines = (
        "  ".join(cell.rjust(w) if i else cell.ljust(w) for i, (cell, w) in enumerate(zip(row, widths)))
        for row in table
    )
    return "\n".join(line.rstrip() for line in lines)


def _rows(metrics: dict) -> list[tuple[str, dict, bool]]:
    """Name, figures, and whether the row is a total."""
    rows = [("all frames", metrics, True), ("accepted only", metrics["accepted_only"], True)]
    if len(metrics["styles"]) > 1:
        rows += [(style, values, False) for style, values in metrics["styles"].items()]
    return rows


def cells(values: dict) -> list[str]:
    """The texts of COLUMNS for one entry of metrics.json."""
    texts = []
    for _, _, keys, factor, digits in COLUMNS:
        value = values
        for key in keys:
            value = value[key]
        texts.append("–" if value is None else f"{factor * value:.{digits}f}")
    return texts


def embedded(path: Path) -> str:
    """A PNG file as a data URI."""
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")


def embedded_photograph(path: Path) -> str:
    """As JPEG: a sheet of frames is several MB as PNG, too much for a report that is sent by mail."""
    import cv2

    image = cv2.imencode(".jpg", files.read_image_rgb(path)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])[1]
    return "data:image/jpeg;base64," + base64.b64encode(image.tobytes()).decode("ascii")
