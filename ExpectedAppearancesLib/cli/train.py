"""`train CASE`: P_Omega, exported to ONNX."""

from __future__ import annotations

import argparse


def add_parser(subparsers) -> None:
    parser = subparsers.add_parser(
        "train",
        help="train the pose network on the expected appearances",
        description="Trains the patient's pose network P_Omega and exports it to ONNX. Interrupted, it goes on where "
        "it was. Chooses its epoch on poses and a texture that it does not train on.",
        formatter_class=argparse.ArgumentDefaultsHelpFormatter,
    )
    parser.add_argument("case", metavar="CASE", help="case folder")
    parser.add_argument(
        "--preset",
        choices=("quick", "best", "paper"),
        default="quick",
        help="quick: for a CPU; best: larger and longer, for a GPU; paper: the paper's network, loss and schedule",
    )
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="where to compute")
    parser.add_argument("--seed", type=int, default=0, help="seed of weights and views")
    parser.add_argument("--minutes", type=float, help="longest training time; left out: the preset's")
    parser.add_argument("--steps", type=int, help="training steps; left out: the preset's")
    parser.add_argument(
        "--appearances",
        choices=("surface", "image"),
        help="method whose appearances are used; left out: the one that is complete",
    )
    parser.set_defaults(run=run)


def run(args, progress) -> None:
    import os

    # Threads that wait for each other must sleep, not spin: rendering of the next views needs the core.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    from dataclasses import replace

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
    problems.raise_if_any()

    from ..devices import choose_device
    from ..model.presets import PRESETS
    from ..model.training import train_case

    given = {name: getattr(args, name) for name in ("minutes", "steps") if getattr(args, name) is not None}
    preset = replace(PRESETS[args.preset], **given)
    figures = train_case(case, preset, progress, choose_device(args.device), args.seed, args.appearances)
    print(
        f"Validation on unseen synthetic views: ADD {figures['add_mm_mean']:.2f} mm mean, "
        f"{figures['add_mm_median']:.2f} mm median, {100 * figures['add_below_3mm']:.1f} % below 3 mm."
    )
    print(f"Model: {case.model_folder / 'model.onnx'}")
