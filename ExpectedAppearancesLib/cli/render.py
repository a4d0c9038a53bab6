"""`render CASE`: poses and label maps."""

from __future__ import annotations

import argparse

from ..poses.sampling import PoseRanges

USUAL = PoseRanges()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Samples plausible microscope poses over the craniotomy and renders a label map for each "
        "(0 background, 1 parenchyma, 2 vessels). The ranges given here are also those of training."
    )
    parser.formatter_class = argparse.ArgumentDefaultsHelpFormatter
    parser.add_argument("case", metavar="CASE", help="case folder")
    parser.add_argument("--poses", type=int, default=100, metavar="N", help="number of poses")
    parser.add_argument("--seed", type=int, default=0, help="seed; the same seed gives the same poses")
    parser.add_argument(
        "--tilt-deg", type=float, default=USUAL.tilt_max_deg, help="largest tilt from the outward axis, degrees"
    )
    parser.add_argument(
        "--roll-deg",
        type=float,
        default=USUAL.roll_max_deg,
        help="largest rotation of the image, degrees, from the patient's superior direction upwards (180: any)",
    )
    parser.add_argument(
        "--working-distance-mm",
        type=float,
        nargs=2,
        metavar=("NEAREST", "FARTHEST"),
        help="working distance, mm; left out: from the vessels overfilling the view (x 0.75) to small in it (x 1.4)",
    )
    parser.add_argument(
        "--lateral-mm", type=float, help="largest lateral offset, mm; left out: a quarter of the vessels' radius"
    )
    parser.add_argument(
        "--in-view",
        type=float,
        default=USUAL.in_view_min,
        help="least share of the vessels that must be in view, 0 to 1",
    )
    parser.add_argument(
        "--point", type=float, nargs=3, metavar=("X", "Y", "Z"), help="centre of the craniotomy, world mm"
    )
    parser.add_argument(
        "--normal", type=float, nargs=3, metavar=("X", "Y", "Z"), help="outward axis of the craniotomy, world"
    )
    parser.add_argument(
        "--circular-field",
        type=float,
        metavar="SHARE",
        help="keep only a circle of this share of the image height as radius (the paper's authors use 0.333)",
    )


def run(args, progress) -> None:
    from ..case.case import Case
    from ..masks.stage import render_case
    from ..poses.craniotomy import find_craniotomy
    from ..runs.record import exclusive

    case = Case.open(args.case)
    ranges = PoseRanges(
        args.tilt_deg,
        args.roll_deg,
        tuple(args.working_distance_mm) if args.working_distance_mm else None,
        args.lateral_mm,
        args.in_view,
    )
    craniotomy = find_craniotomy(case.vessels, case.cortex, case.space, args.point, args.normal)
    with exclusive(case.folder, "render"):
        render_case(case, progress, args.poses, args.seed, ranges, craniotomy, args.circular_field)
