"""The results section as one HTML file with its pictures inside, from the study.json of one or more cases."""

from __future__ import annotations

import datetime
from collections.abc import Iterable, Sequence
from pathlib import Path

from .. import __version__, files
from .curves import write_reliability
from .report import COLUMNS, RELIABILITY_SECTION, STYLE_SHEET, cells, embedded, embedded_photograph
from .study_figures import write_study_curves, write_texture_bars, write_texture_counts

PROTOCOL_NAMES = {
    "strict": "strict (unseen texture, unseen poses)",
    "loto": "paper's form (unseen texture, seen poses)",
}

_TEMPLATE = (
    """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Study of {{ cases }}</title><style>{{ style_sheet }}
summary { cursor: pointer; } details { margin: .6em 0; } .left { text-align: left; }
</style></head><body>
{% macro figures(rows, first) %}
<div class="scroll"><table><thead><tr><th>{{ first }}</th>
{% for name, unit in headings %}<th>{{ name }}{% if unit %}<br>{{ unit }}{% endif %}</th>{% endfor %}</tr></thead>
<tbody>{% for name, texts in rows %}<tr><td>{{ name }}</td>
{% for text in texts %}<td>{{ text }}</td>{% endfor %}</tr>
{% endfor %}</tbody></table></div>
{% endmacro %}
<h1>Study of {{ cases }}</h1>
<p class="note">{{ date }} &middot; ExpectedAppearances {{ version }} &middot;
for research only, not a medical device</p>
{% if all_rows %}<h2>Leave one texture out</h2>
<p>For each texture a model is trained on appearances of the others and tested on frames of the one left out.
<b>Strict</b>: every training view has a pose of its own, so neither texture nor pose of a test frame was ever seen.
<b>Paper's form</b>: training views are seen from the very poses of the test frames, as in Haouchine et al., MICCAI
2023, whose training and test images share their poses; it measures memory of poses too.
Epoch and threshold for refusal are chosen on synthesised views of an inner split, never on the texture left out.</p>
{{ figures(all_rows, "case, model, protocol") }}
{% for text in trainings %}<p class="note">{{ text }}</p>
{% endfor %}
{% for name, nearest, mean in baselines %}<p class="note">{{ name }}: always answering the mean pose of these
frames gives ADD {{ mean }} mm; answering the nearest other pose of the frames, chosen knowing the truth,
{{ nearest }} mm.</p>
{% endfor %}
<p class="note">ADD: mean over the vessel mesh's vertices of the distance between true and predicted position, in the
camera frame; lateral and depth are its parts across and along the optical axis. n mm-n deg: share of frames with less
than n mm translation error at the mesh centroid and less than n degrees rotation error. AUC: area under the curve of
ADD below 0 to 20 mm. Frames without a pose count as misses in shares and AUC. Refused frames that have a pose are in
these figures; rows "accepted only" leave them out.</p>{% endif %}
{% if curves %}<h2>Accuracy against threshold</h2><img src="{{ curves }}" alt="Accuracy-threshold curves">{% endif %}
{% if bars %}<h2>Each left-out texture</h2><img src="{{ bars }}" alt="Mean ADD on each left-out texture">{% endif %}
"""
    + RELIABILITY_SECTION
    + """
{% for name, rows in per_style %}<details><summary>{{ name }}</summary>{{ figures(rows, "left-out texture") }}</details>
{% endfor %}
{% if counts %}<h2>Number of textures</h2>
<p>{{ left_out_text }}</p><img src="{{ counts }}" alt="Error against the number of training textures">
{{ figures(count_rows, "training textures") }}{% endif %}
{% for name, table in robustness %}<h2>Robustness: {{ name }}</h2>
<p>{{ table.frames }} frames disturbed before they are registered, one way at a time, by {{ table.model }}. Occlusion is
in percent of the lit field. Brain shift bends the image smoothly by at most the given length at the vessels' depth,
without an affine part; errors are those of the rigid pose.</p>
<div class="scroll"><table><thead><tr><th>disturbance</th><th class="left">strength</th><th>ADD mean<br>mm</th>
<th>median<br>mm</th><th>3mm-3deg<br>%</th><th>refused<br>%</th><th>ADD &lt; 3 mm of<br>accepted, %</th></tr></thead>
<tbody>
{% for row in table.rows %}<tr><td>{{ row[0] }}</td><td class="left">{{ row[1] }}</td>
{% for text in row[2:] %}<td>{{ text }}</td>{% endfor %}</tr>{% endfor %}</tbody></table></div>
<img src="{{ table.examples }}" alt="A frame, disturbed in each way">
{% endfor %}
{% if overlays %}<h2>Overlays</h2>
<p>Outline of the vessels at the <span class="true">true</span> and at the <span class="predicted">predicted</span>
pose, from the smallest error to the largest, on textures that the models have not seen.</p>
{% for name, picture in overlays %}<h3>{{ name }}</h3><img src="{{ picture }}" alt="Overlays of {{ name }}">{% endfor %}
{% endif %}
</body></html>
"""
)


def write_study_report(folder: Path, studies: Sequence[tuple[Path, dict]]) -> None:
    """report.html, study.json and the figures (PNG) in `folder`; studies: (case folder, content of its study.json)."""
    import jinja2

    names = _names([case_folder for case_folder, _ in studies])
    several = len(studies) > 1
    # Cases are named in a line only where there is more than one.
    entries = {
        f"{name + ', ' if several else ''}{preset}, {PROTOCOL_NAMES[protocol]}": (case_folder, entry)
        for name, (case_folder, study) in zip(names, studies)
        for preset, protocols in study["presets"].items()
        for protocol, entry in protocols.items()
    }
    counted = {name: study["textures"] for name, (_, study) in zip(names, studies) if study.get("textures")}
    files.write_json(folder / "study.json", {name: study for name, (_, study) in zip(names, studies)})
    reliabilities = {label: e["all"]["reliability"] for label, (_, e) in entries.items() if "reliability" in e["all"]}
    for name, (_, study) in zip(names, studies):
        if (study.get("robustness") or {}).get("reliability"):
            reliabilities[f"{name + ', ' if several else ''}disturbed frames"] = study["robustness"]["reliability"]
    pictures = _pictures(folder, entries, counted, reliabilities)
    template = jinja2.Environment(autoescape=True, trim_blocks=True).from_string(_TEMPLATE)
    html = template.render(
        cases=", ".join(names),
        style_sheet=STYLE_SHEET,
        date=datetime.datetime.now().astimezone().strftime("%Y-%m-%d %H:%M %Z"),
        version=__version__,
        headings=[(name, unit) for name, unit, *_ in COLUMNS],
        all_rows=[row for label, (_, entry) in entries.items() for row in _total_rows(label, entry)],
        trainings=[f"{label}: trained for {_steps(entry['folds'].values())}." for label, (_, entry) in entries.items()],
        baselines=[row for name, (_, study) in zip(names, studies) for row in _baselines(name, study)],
        per_style=[
            (label, [(style, cells(values)) for style, values in entry["per_style"].items()])
            for label, (_, entry) in entries.items()
        ],
        left_out_text=" ".join(_left_out_text(name, study, several) for name, study in counted.items()),
        count_rows=[
            (f"{name}, {row['textures']}" if several else row["textures"], cells(row["metrics"]))
            for name, study in counted.items()
            for row in study["rows"]
        ],
        robustness=[
            (name, _shown_robustness(case_folder, study["robustness"]))
            for name, (case_folder, study) in zip(names, studies)
            if study.get("robustness")
        ],
        overlays=[
            (label, embedded_photograph(case_folder / "study" / entry["overlays"]))
            for label, (case_folder, entry) in entries.items()
            if entry.get("overlays")
        ],
        **pictures,
    )
    files.write_bytes(folder / "report.html", html.encode("utf-8"))


def study_text(study: dict) -> str:
    """The headline figures for a terminal, a line for each model and protocol."""
    lines = []
    for preset, protocols in study["presets"].items():
        for protocol, entry in protocols.items():
            figures, add = entry["all"], entry["all"]["add_mm"]["mean"]
            shares = ", ".join(f"{key} {100 * value:.1f} %" for key, value in figures["accuracy"].items())
            shown = "no frame was given a pose" if add is None else f"ADD {add:.2f} mm"
            auc = entry["thresholds"]["add_auc_20mm"]
            lines.append(
                f"{study['case']}, {preset}, {PROTOCOL_NAMES[protocol]}: {shown}, {shares}, AUC {auc:.3f}, "
                f"{figures['refused']} of {figures['frames']} refused"
            )
    return "\n".join(lines)


def robustness_rows(table: dict) -> list[list[str]]:
    """Disturbance, strength, ADD mean, median, 3mm-3deg, refused share, ADD < 3 mm of accepted; the kind said once."""
    rows, kind = [], None
    for row in [{"kind": "none", "strength": "", "metrics": table["undisturbed"]}, *table["rows"]]:
        metrics = row["metrics"]
        values = (metrics["add_mm"]["mean"], metrics["add_mm"]["median"])
        shares = (
            metrics["accuracy"]["3mm-3deg"],
            metrics["refused"] / metrics["frames"],
            metrics["accepted_add_below_3mm"],
        )
        texts = ["–" if v is None else f"{v:.2f}" for v in values]
        texts += ["–" if v is None else f"{100 * v:.1f}" for v in shares]
        rows.append([row["kind"] if row["kind"] != kind else "", row["strength"], *texts])
        kind = row["kind"]
    return rows


def _pictures(folder: Path, entries: dict, counted: dict, reliabilities: dict) -> dict[str, str]:
    pictures = dict.fromkeys(("curves", "bars", "reliability", "counts"), "")
    if entries:
        write_study_curves(folder / "curves.png", {label: entry["thresholds"] for label, (_, entry) in entries.items()})
        write_texture_bars(
            folder / "textures.png", {label: entry["per_style"] for label, (_, entry) in entries.items()}
        )
        pictures |= {"curves": embedded(folder / "curves.png"), "bars": embedded(folder / "textures.png")}
    if reliabilities:
        write_reliability(folder / "reliability.png", reliabilities)
        pictures["reliability"] = embedded(folder / "reliability.png")
    if counted:
        write_texture_counts(folder / "texture_counts.png", {name: study["rows"] for name, study in counted.items()})
        pictures["counts"] = embedded(folder / "texture_counts.png")
    return pictures


def _total_rows(label: str, entry: dict) -> list[tuple[str, list[str]]]:
    rows = [(label, cells(entry["all"]))]
    if 0 < entry["all"]["accepted_only"]["frames"] < entry["all"]["frames"]:
        rows.append((f"{label}: accepted only", cells(entry["all"]["accepted_only"])))
    return rows


def _shown_robustness(case_folder: Path, table: dict) -> dict:
    picture = embedded_photograph(case_folder / "study" / table["examples"])
    return table | {"rows": robustness_rows(table), "examples": picture}


def _names(folders: Sequence[Path]) -> list[str]:
    """A name for each case: its folder's, with as many of the folders above as tell all apart."""
    parts = [Path(folder).parts for folder in folders]
    for depth in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-depth:]) for part in parts]
        if len(set(names)) == len(names):
            break
    return names


def _baselines(name: str, study: dict) -> list[tuple[str, str, str]]:
    entry = next((e for protocols in study["presets"].values() for e in protocols.values()), None)
    nearest = study["nearest_other_pose_add_mm"]
    if entry is None or nearest is None:
        return []
    return [(name, f"{nearest:.2f}", f"{entry['all']['mean_pose_add_mm']:.2f}")]


def _left_out_text(name: str, study: dict, several: bool) -> str:
    start = f"{name}: tested" if several else "Tested"
    text = f"{start} on frames of {', '.join(study['left_out'])}, which no model ({study['preset']}) was trained on"
    # Time may end a training before its steps do.
    steps = _steps([row["training"] for row in study["rows"]])
    differ = ", so models differ in more than their textures" if " to " in steps else ""
    return f"{text}; they were trained for {steps}{differ}."


def _steps(trainings: Iterable[dict]) -> str:
    steps = sorted({training["steps"] for training in trainings})
    return f"{steps[0]} steps" if len(steps) == 1 else f"{steps[0]} to {steps[-1]} steps"
