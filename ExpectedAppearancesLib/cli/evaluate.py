"""`evaluate`: metrics, curves, overlays and a report against known poses."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_parser(subparsers) -> None:
    parser = subparsers.add_parser(
        "evaluate",
        help="measure predicted poses against known ones",
        description="Registers frames whose poses are known with the case's model, and writes metrics.json, the "
        "predicted poses, accuracy-threshold curves, overlays (true outline green, predicted blue) and report.html.",
    )
    parser.add_argument("case", type=Path, metavar="CASE", help="case folder with a trained model")
    parser.add_argument("--poses", type=Path, required=True, metavar="FILE", help="poses.json with the KNOWN poses")
    parser.add_argument("--styles", type=_names, metavar="A,B", help="only frames of these styles")
    parser.add_argument(
        "--predicted",
        type=Path,
        metavar="FILE",
        help="poses.json to compare, as `register` writes it, instead of running the model",
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    parser.set_defaults(run=run)


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names:
        raise argparse.ArgumentTypeError("names no style; give them separated by commas")
    return names


def run(args: argparse.Namespace, progress) -> None:
    from ..case.case import Case
    from ..evaluation.evaluate import evaluate
    from ..evaluation.report import text_table

    case = Case.open(args.case)
    evaluation = evaluate(case, args.poses, args.out, args.styles, args.predicted, progress)
    print(text_table(evaluation.metrics))
    print(f"Results: {Path(args.out).absolute() / 'report.html'}")
