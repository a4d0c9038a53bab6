"""`evaluate`: metrics, curves, overlays and a report against known poses."""

from __future__ import annotations

import argparse
from pathlib import Path

from . import comma_separated


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Registers frames whose poses are known with the case's model, and writes metrics.json, the "
        "predicted poses, accuracy-threshold curves, overlays (true outline green, predicted blue) and report.html."
    )
    parser.add_argument("case", type=Path, metavar="CASE", help="case folder with a trained model")
    parser.add_argument("--poses", type=Path, required=True, metavar="FILE", help="poses.json with the KNOWN poses")
    parser.add_argument("--styles", type=comma_separated, metavar="A,B", help="only frames of these styles")
    parser.add_argument(
        "--predicted",
        type=Path,
        metavar="FILE",
        help="poses.json to compare, as `register` writes it, instead of running the model",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")


def run(args: argparse.Namespace, progress) -> None:
    from ..case.case import Case
    from ..evaluation.evaluate import evaluate
    from ..evaluation.report import text_table

    case = Case.open(args.case)
    evaluation = evaluate(case, args.poses, args.out, args.styles, args.predicted, progress)
    print(text_table(evaluation.metrics))
    print(f"Results: {Path(args.out).absolute() / 'report.html'}")
