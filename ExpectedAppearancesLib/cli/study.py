"""`study CASE...`: the paper's results section."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..appearances import METHODS
from ..executor import LOCAL
from ..model.presets import PRESETS
from . import comma_separated


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Trains models on some textures of a case and tests them on frames of the others, whose poses are "
        "known: those of --poses, else views of the case's own appearances. Protocol strict: unseen texture and unseen "
        "poses. Protocol loto: the paper's leave-one-texture-out, "
        "where training views repeat the poses of the test frames. Writes CASE/study/study.json and one HTML report, "
        "its pictures inside. Interrupted, it goes on where it was; the case's own model stays as it is."
    )
    parser.formatter_class = argparse.ArgumentDefaultsHelpFormatter
    parser.add_argument("cases", nargs="+", type=Path, metavar="CASE", help="case folders with appearances")
    parser.add_argument(
        "--poses",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="poses.json with the KNOWN poses of each case's frames, their 'style' called like the texture; left out: "
        "frames are drawn from the case's appearances, at poses of their own",
    )
    parser.add_argument("--frames", type=int, default=24, metavar="N", help="frames to draw of each texture")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the report; left out: CASE/study/report")
    parser.add_argument(
        "--protocols", type=comma_separated, default="strict,loto", metavar="A,B", help="strict, loto, or none"
    )
    parser.add_argument(
        "--preset",
        type=comma_separated,
        default="quick",
        metavar="A,B",
        help=f"what is trained: {', '.join(PRESETS)}; several are compared on the same frames",
    )
    parser.add_argument(
        "--styles", type=comma_separated, metavar="A,B", help="textures to leave out; left out: all with frames"
    )
    parser.add_argument(
        "--textures-study",
        action="store_true",
        help="also: 3 to 12 training textures, 3 others left out, equal steps where --minutes allows",
    )
    parser.add_argument("--robustness", action="store_true", help="also: error and refusals of disturbed frames")
    parser.add_argument("--robustness-frames", type=int, default=80, metavar="N", help="frames to disturb")
    parser.add_argument("--steps", type=int, help="steps of each training; left out: the preset's")
    parser.add_argument("--minutes", type=float, help="longest time of each training; left out: the preset's")
    parser.add_argument("--seed", type=int, default=0, help="seed of weights, views and choices")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to train")
    parser.add_argument("--appearances", choices=METHODS, help="method whose appearances are used")
    parser.add_argument(
        "--executor",
        default=LOCAL,
        metavar="WHERE",
        help="local: one training after another; dask://HOST:PORT: on the workers of that scheduler, which must see "
        "the same folders (start them with one thread each)",
    )


def run(args: argparse.Namespace, progress) -> None:
    import contextlib

    from ..errors import Problems
    from ..evaluation.study import StudySettings, run_study, study_path
    from ..evaluation.study_report import study_text
    from ..runs.record import exclusive

    problems = Problems()
    if args.poses and len(args.poses) != len(args.cases):
        problems.add(f"--poses: {len(args.poses)} files for {len(args.cases)} cases; give one for each, in order.")
    if args.out is None and len(args.cases) > 1:
        problems.add("--out: missing; give a folder for the report on several cases.")
    problems.raise_if_any()
    out = args.out or study_path(args.cases[0]).parent / "report"
    settings = StudySettings(
        protocols=() if args.protocols == ("none",) else args.protocols,
        presets=args.preset,
        styles=args.styles,
        textures_study=args.textures_study,
        robustness=args.robustness,
        robustness_frames=args.robustness_frames,
        steps=args.steps,
        minutes=args.minutes,
        seed=args.seed,
        device=args.device,
        method=args.appearances,
        executor=args.executor,
        frames=args.frames,
    )
    pairs = list(zip(args.cases, args.poses or [None] * len(args.cases)))
    with contextlib.ExitStack() as locks:
        for case in args.cases:
            if (case / "case.json").is_file():  # else the study says so
                locks.enter_context(exclusive(case.absolute(), "study"))
        studies = run_study(pairs, out, settings, progress)
    for case, study in zip(args.cases, studies):
        print(study_text(study))
        print(f"Figures: {study_path(case)}")
    print(f"Report: {out.absolute() / 'report.html'}")
