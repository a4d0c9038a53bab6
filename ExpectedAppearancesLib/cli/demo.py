"""`demo`: the whole pipeline on a small generated case."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Generates a vessel tree on a curved cortex and test frames painted in ways that are never trained "
        "on, then runs every stage, offline and on a CPU: new, render, synthesize, train, register, evaluate. Ends "
        "with overlays (PNG), a report and a scene for 3D Slicer. Started again, it goes on where it was."
    )
    parser.formatter_class = argparse.ArgumentDefaultsHelpFormatter
    parser.add_argument(
        "--out", type=Path, default=Path("expected-appearances-demo"), metavar="DIR", help="folder to fill"
    )
    parser.add_argument("--seed", type=int, default=0, help="another seed is another patient")
    parser.add_argument("--minutes", type=float, default=6.0, help="training time")
    parser.add_argument("--textures", type=int, default=6, help="how many of the shipped textures to use")


def run(args, progress) -> None:
    from ..demo.pipeline import run_demo
    from ..errors import InputError

    if args.minutes <= 0 or args.textures < 1 or args.seed < 0:
        raise InputError("demo: --minutes must be above 0, --textures at least 1 and --seed at least 0.")
    metrics = run_demo(args.out, progress, args.seed, args.minutes, args.textures)
    accepted = metrics["frames"] - metrics["refused"]
    print(
        f"On unseen poses and textures: ADD {metrics['add_mm']['mean']:.2f} mm mean, "
        f"{metrics['add_mm']['median']:.2f} mm median; {accepted} of {metrics['frames']} frames accepted."
    )
    print(f"Overlays: {args.out / 'evaluation' / 'overlays.png'}")
    print(f"Report:   {args.out / 'evaluation' / 'report.html'}")
    print(f"Scene:    {args.out / 'scene.mrb'} (open it in 3D Slicer)")
