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
    """Of accepted views, since these are what a surgeon is shown: add_mm, largest mean ADD; right_min, least share,
    0..1, with ADD below 3 mm. accepted_min: least share of views that are accepted; most are disturbed more than frames
    of a microscope usually are, so few of them are enough."""

    add_mm: float = 1.5
    right_min: float = 0.97
    accepted_min: float = 0.2


@dataclass(frozen=True)
class Figures:
    """One row of the validation table, of all views but where it says accepted; shares 0..1, None where the figure was
    not measured. accepted_right: share of the accepted with ADD below 3 mm."""

    protocol: str
    style: str
    add_mm_mean: float | None = None
    add_mm_median: float | None = None
    add_mm_p95: float | None = None
    accuracy_3: float | None = None
    accuracy_5: float | None = None
    accepted: float | None = None
    accepted_add_mm: float | None = None
    accepted_right: float | None = None


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
    measured = {
        "add_mm_mean": "add_mm_mean",
        "add_mm_median": "add_mm_median",
        "accepted": "accepted_of_true",
        "accepted_add_mm": "accepted_add_mm_mean",
        "accepted_right": "accepted_add_below_3mm",
    }
    return [Figures(OWN_VALIDATION, "", **{name: values.get(key) for name, key in measured.items()})]


def deciding(rows: list[Figures]) -> Figures | None:
    """The row, of all textures, of the strictest protocol there is."""
    of_all = {row.protocol: row for row in rows if not row.style}
    return next((of_all[name] for name in ("strict", OWN_VALIDATION, "loto") if name in of_all), None)


def verdict(rows: list[Figures], limits: Limits) -> tuple[bool, tuple[str, ...]] | None:
    """(ready, what keeps it from being ready) on the strictest protocol there is; None without figures."""
    row = deciding(rows)
    if row is None:
        return None
    if row.accepted == 0:
        return False, ("no view is accepted",)
    reasons = []
    if row.accepted_add_mm is None:
        reasons.append("mean ADD of accepted views unknown, as of models of older versions: train again")
    elif row.accepted_add_mm > limits.add_mm:
        reasons.append(f"mean ADD of accepted views {row.accepted_add_mm:.2f} mm, limit {limits.add_mm:.1f} mm")
    for name, value, least in (
        ("of accepted views with ADD below 3 mm", row.accepted_right, limits.right_min),
        ("of views accepted", row.accepted, limits.accepted_min),
    ):
        if value is None or value < least:
            share = "an unknown share" if value is None else f"{100 * value:.0f} %"
            reasons.append(f"{share} {name}, at least {100 * least:.0f} % wanted")
    return not reasons, tuple(reasons)


def _of_metrics(protocol: str, style: str, metrics: dict) -> Figures:
    add, accuracy, shown = metrics["add_mm"], metrics["accuracy"], metrics["accepted_only"]
    frames = metrics["frames"]
    return Figures(
        protocol,
        style,
        add["mean"],
        add["median"],
        add.get("p95"),
        accuracy.get("3mm-3deg"),
        accuracy.get("5mm-5deg"),
        (frames - metrics["refused"]) / frames if frames else None,
        shown["add_mm"]["mean"],
        shown["add_below_3mm"],
    )
