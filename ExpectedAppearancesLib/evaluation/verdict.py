"""Whether a patient's model is good enough: its figures of merit against limits that the user sets."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import InputError

STUDY_FORMAT = "ExpectedAppearances study"
OWN_VALIDATION = "own validation"
PROTOCOL_NAMES = {
    "strict": "unseen texture and pose",
    "loto": "unseen texture, seen poses",
    OWN_VALIDATION: "the model's own validation",
}


@dataclass(frozen=True)
class Limits:
    """add_mm: largest mean ADD. accepted_min, accuracy_min: least share, 0..1, of frames accepted, within 3mm-3deg."""

    add_mm: float = 3.0
    accepted_min: float = 0.5
    accuracy_min: float = 0.8


@dataclass(frozen=True)
class Figures:
    """One row of the validation table; shares 0..1, None where the figure was not measured.

    accuracy_3: share within 3mm-3deg; for the model's own validation, of views with ADD below 3 mm.
    """

    protocol: str
    style: str
    add_mm_mean: float | None
    add_mm_median: float | None
    add_mm_p95: float | None
    accuracy_3: float | None
    accuracy_5: float | None
    accepted: float | None


def figures_of_study(study: dict) -> list[Figures]:
    """Rows of study.json, for each protocol first all frames, then each style. Raises InputError for other content."""
    if not isinstance(study, dict) or study.get("format") != STUDY_FORMAT:
        raise InputError("study.json: not the figures of a study; remove the file, or run the study again.")
    rows = []
    try:
        for protocol in sorted(study["protocols"], key=lambda name: name != "strict"):
            content = study["protocols"][protocol]
            rows.append(_of_metrics(protocol, "", content["all"]))
            rows += [
                _of_metrics(protocol, style, content["per_style"][style]) for style in sorted(content["per_style"])
            ]
    except (KeyError, TypeError, AttributeError) as error:
        raise InputError(f"study.json: lacks {error}; run the study again.") from error
    return rows


def figures_of_model(model: dict) -> list[Figures]:
    """The row of a model's own validation, from model.json."""
    values = model.get("validation") or {}
    if not values:
        return []
    mean, median, below = (values.get(key) for key in ("add_mm_mean", "add_mm_median", "add_below_3mm"))
    return [Figures(OWN_VALIDATION, "", mean, median, None, below, None, values.get("accepted_of_true"))]


def deciding(rows: list[Figures]) -> Figures | None:
    """The row, of all textures, of the strictest protocol there is."""
    of_all = {row.protocol: row for row in rows if not row.style}
    return next((of_all[name] for name in ("strict", OWN_VALIDATION, "loto") if name in of_all), None)


def verdict(rows: list[Figures], limits: Limits) -> tuple[bool, tuple[str, ...]] | None:
    """(ready, what keeps it from being ready) on the strictest protocol there is; None without figures."""
    row = deciding(rows)
    if row is None:
        return None
    accuracy_name = "of views with ADD below 3 mm" if row.protocol == OWN_VALIDATION else "within 3 mm and 3°"
    reasons = []
    if row.add_mm_mean is None or row.add_mm_mean > limits.add_mm:
        reasons.append(f"mean ADD {_text(row.add_mm_mean, 'mm')}, limit {limits.add_mm:.1f} mm")
    for name, value, least in (
        (accuracy_name, row.accuracy_3, limits.accuracy_min),
        ("accepted", row.accepted, limits.accepted_min),
    ):
        if value is None or value < least:
            reasons.append(f"{_text(value, '%')} {name}, at least {100 * least:.0f} % wanted")
    return not reasons, tuple(reasons)


def _of_metrics(protocol: str, style: str, metrics: dict) -> Figures:
    add, accuracy = metrics["add_mm"], metrics["accuracy"]
    frames = metrics["frames"]
    accepted = (frames - metrics["refused"]) / frames if frames else None
    return Figures(
        protocol,
        style,
        add["mean"],
        add["median"],
        add.get("p95"),
        accuracy.get("3mm-3deg"),
        accuracy.get("5mm-5deg"),
        accepted,
    )


def _text(value: float | None, unit: str) -> str:
    if value is None:
        return "unknown"
    return f"{value:.2f} mm" if unit == "mm" else f"{100 * value:.0f} %"
