"""`new`: make a case folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..case.case import SPACES, Case
from ..errors import Problems
from ..geometry.camera import Camera

DESCRIPTION = """\
Make the folder of a case from the vessel mesh M around the craniotomy, the cortex mesh (optional) and the camera.
Everything is checked first; a problem leaves no folder behind.

The camera comes from --camera, either camera.json (width, height, fx, fy, cx, cy, distortion; px, pixel centres at
integers) or the YAML/XML that OpenCV's calibration writes. Without a calibration, give --field-of-view-mm,
--working-distance-mm and --image-size as the microscope states them."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = DESCRIPTION
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("case", type=Path, metavar="CASE", help="folder to make; it must not exist, or be empty")
    parser.add_argument(
        "--vessels", type=Path, required=True, metavar="FILE", help="vessel mesh in mm (.vtp, .vtk, .stl, .ply, .obj)"
    )
    parser.add_argument(
        "--cortex", type=Path, metavar="FILE", help="cortex mesh in mm, in the same space (default: a disc is used)"
    )
    parser.add_argument("--camera", type=Path, metavar="FILE", help="camera.json or OpenCV calibration")
    parser.add_argument(
        "--field-of-view-mm", type=float, metavar="MM", help="width of the view at the working distance"
    )
    parser.add_argument("--working-distance-mm", type=float, metavar="MM", help="distance from the lens to the cortex")
    parser.add_argument("--image-size", type=_image_size, metavar="WxH", help="size of the frames in px, as 1920x1080")
    parser.add_argument(
        "--space", choices=SPACES, default="LPS", help="axes of the mesh files' coordinates (default: %(default)s)"
    )


def run(args, progress) -> None:
    problems = Problems()
    camera = args.camera or None
    view = (args.field_of_view_mm, args.working_distance_mm, args.image_size)
    names = ("--field-of-view-mm", "--working-distance-mm", "--image-size")
    if camera and any(value is not None for value in view):
        problems.add("--camera: already gives the field of view; give either it, or " + ", ".join(names) + ".")
    elif not camera:
        missing = [name for name, value in zip(names, view) if value is None]
        if missing:
            problems.add(f"camera: not given; give --camera FILE, or also {', '.join(missing)}.")
        else:
            with problems.collect():
                camera = Camera.from_field_of_view(*args.image_size, args.field_of_view_mm, args.working_distance_mm)
    if problems.found:
        with problems.collect():
            Case.check_inputs(args.case, args.vessels, args.cortex, camera, args.space)
        problems.raise_if_any()
    case = Case.create(args.case, args.vessels, args.cortex, camera, args.space)
    view_mm = case.camera.field_of_view_mm(300.0)
    print(f"{case.folder}: case made, {case.space} coordinates.")
    print(f"Vessels: {_summary(case.vessels)}. Cortex: {_summary(case.cortex) if case.cortex else 'none'}.")
    print(f"Camera: {case.camera.width} x {case.camera.height} px, sees {view_mm:.0f} mm at 300 mm.")
    progress(1.0, "case made")


def _summary(mesh) -> str:
    return f"{len(mesh.vertices_mm)} vertices, {len(mesh.triangles)} triangles, {2 * mesh.radius_mm:.0f} mm across"


def _image_size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit() and int(width) and int(height)):
        raise argparse.ArgumentTypeError(f"'{text}' is not a size such as 1920x1080")
    return int(width), int(height)
