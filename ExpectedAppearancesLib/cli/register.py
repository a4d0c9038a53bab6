"""`register CASE IMAGE...`: the pose of each frame."""

from __future__ import annotations

from pathlib import Path


def add_parser(subparsers) -> None:
    parser = subparsers.add_parser(
        "register",
        help="find the pose of microscope frames",
        description="Finds the pose of each frame with the case's trained model and writes poses.json. A frame whose "
        "pose cannot be trusted is refused (accepted: false). Images may be PNG, JPEG or TIFF of any size.",
    )
    parser.add_argument("case", metavar="CASE", help="case folder")
    parser.add_argument("images", nargs="+", type=Path, metavar="IMAGE", help="microscope frames")
    parser.add_argument("--out", type=Path, required=True, metavar="poses.json", help="file to write")
    parser.add_argument("--camera", type=Path, metavar="FILE", help="camera of the frames, if not the case's")
    parser.set_defaults(run=run)


def run(args, progress) -> None:
    from .. import files
    from ..case.case import Case
    from ..errors import InputError, Problems
    from ..geometry.camera import read_camera
    from ..registration.poses_file import write_poses
    from ..registration.predictor import Predictor
    from ..registration.record import frame_record

    problems = Problems()
    case = camera = predictor = None
    with problems.collect():
        case = Case.open(args.case)
    with problems.collect():
        camera = read_camera(args.camera) if args.camera else None
    if case:
        with problems.collect():
            predictor = Predictor(case.model_folder)
    for path in args.images:
        if not path.is_file():
            problems.add(f"{path}: image not found; check the path.")
    problems.raise_if_any()
    camera = camera or case.camera
    frames = []
    for i, path in enumerate(args.images):
        with problems.collect():
            image = files.read_image_rgb(path)
            try:
                frames.append(frame_record(path, predictor.predict(image, camera)))
            except InputError as error:
                problems.add(f"{path}: {error}")
        progress((i + 1) / len(args.images), f"frame {i + 1} of {len(args.images)}")
    problems.raise_if_any()
    write_poses(args.out, camera, frames)
    accepted = sum(frame["accepted"] for frame in frames)
    print(f"{accepted} of {len(frames)} frames accepted. Poses: {args.out}")
