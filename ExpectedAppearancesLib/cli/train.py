"""`train CASE`: P_Omega, exported to ONNX."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..appearances import METHODS
from ..model.presets import PRESETS

ORPHAN_ENDS_S = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Trains the patient's pose network P_Omega and exports it to ONNX. Interrupted, it goes on where "
        "it was. Chooses its epoch on poses and a texture that it does not train on."
    )
    parser.formatter_class = argparse.ArgumentDefaultsHelpFormatter
    parser.add_argument("case", metavar="CASE", help="case folder")
    parser.add_argument(
        "--preset",
        choices=tuple(PRESETS),
        default="quick",
        help="quick: half an hour on a CPU; best: reads frames finer, 90 minutes; paper: the paper's network, loss and "
        "schedule; probseg, binseg: its rivals, which segment the vessels first",
    )
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to compute")
    parser.add_argument("--seed", type=int, default=0, help="seed of weights and views")
    parser.add_argument("--minutes", type=float, help="longest training time; left out: the preset's")
    parser.add_argument("--steps", type=int, help="training steps; left out: the preset's")
    parser.add_argument(
        "--appearances",
        choices=METHODS,
        help="method whose appearances are used; left out: the one that is complete",
    )
    study = parser.add_argument_group("models for a study (the case's own model stays as it is)")
    study.add_argument("--model-folder", type=Path, metavar="DIR", help="folder of such a model")
    study.add_argument("--exclude", nargs="+", default=[], metavar="STYLE", help="textures to leave out")
    study.add_argument(
        "--poses",
        type=Path,
        metavar="FILE",
        help="poses.json whose poses training repeats, as the paper's leave-one-texture-out does; left out: fresh ones",
    )
    study.add_argument(
        "--no-inner-texture",
        action="store_true",
        help="train on every texture that is not left out, and choose the epoch on other poses alone",
    )


def run(args, progress) -> None:
    import os

    # Threads that wait for each other must sleep, not spin: rendering of the next views needs the core.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from ..case.case import Case
    from ..errors import Problems

    problems = Problems()
    case = None
    with problems.collect():
        case = Case.open(args.case)
    for name in ("minutes", "steps"):
        value = getattr(args, name)
        if value is not None and value <= 0:
            problems.add(f"--{name}: {value}; it must be above 0.")
    if args.seed < 0:
        problems.add(f"--seed: {args.seed}; give 0 or more.")
    if args.model_folder is None and (args.exclude or args.poses or args.no_inner_texture):
        problems.add("--model-folder: missing; --exclude, --poses and --no-inner-texture make no model for use.")
    problems.raise_if_any()

    from ..runs.record import exclusive

    # A study that was killed leaves a training that ends when it next speaks.
    with exclusive(args.model_folder or case.folder, "train", ORPHAN_ENDS_S if args.model_folder else 0.0):
        _train(args, case, progress)


def _train(args, case, progress) -> None:
    from dataclasses import replace

    from ..devices import choose_device
    from ..model.fold import Fold
    from ..model.training import train_case

    given = {name: getattr(args, name) for name in ("minutes", "steps") if getattr(args, name) is not None}
    preset = replace(PRESETS[args.preset], **given)
    fold = None
    if args.model_folder:
        fold = Fold(args.model_folder.absolute(), tuple(args.exclude), args.poses, not args.no_inner_texture)
    figures = train_case(case, preset, progress, choose_device(args.device), args.seed, args.appearances, fold)
    print(
        f"Validation on unseen synthetic views: ADD {figures['add_mm_mean']:.2f} mm mean, "
        f"{figures['add_mm_median']:.2f} mm median, {100 * figures['add_below_3mm']:.1f} % below 3 mm."
    )
    print(f"Model: {(args.model_folder or case.model_folder) / 'model.onnx'}")
