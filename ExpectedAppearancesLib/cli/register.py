"""`register CASE IMAGE...`: the pose of each frame."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Finds the pose of each frame with the case's trained model and writes poses.json. A frame whose "
        "pose cannot be trusted is refused (accepted: false). Images may be PNG, JPEG or TIFF of any size; a video is "
        "given in their place, alone."
    )
    parser.add_argument("case", metavar="CASE", help="case folder")
    parser.add_argument("images", nargs="+", type=Path, metavar="IMAGE", help="microscope frames, or one video")
    parser.add_argument("--out", type=Path, required=True, metavar="poses.json", help="file to write")
    parser.add_argument("--camera", type=Path, metavar="FILE", help="camera of the frames, if not the case's")
    parser.add_argument(
        "--track",
        action="store_true",
        help="also filter the poses over time (images in the order of time): tracked_camera_from_world and tracking",
    )
    parser.add_argument(
        "--fps", type=float, metavar="HZ", help="frames per second, of images or where a video's own are wrong"
    )


def run(args, progress) -> None:
    from ..case.case import Case
    from ..errors import InputError, Problems
    from ..geometry.camera import read_camera
    from ..registration.footage import Footage
    from ..registration.poses_file import check_place, write_poses
    from ..registration.predictor import open_predictor
    from ..registration.record import frame_record, tracking_record
    from ..registration.tracking import Tracker, TrackerSettings, TrackState

    problems = Problems()
    case = camera = predictor = footage = None
    with problems.collect():
        case = Case.open(args.case)
    with problems.collect():
        camera = read_camera(args.camera) if args.camera else None
    if case:
        with problems.collect():
            predictor = open_predictor(case)
    with problems.collect():
        footage = Footage(args.images, args.fps)
    with problems.collect():  # a long video's poses must not be lost for want of a place
        check_place(args.out)
    if footage and args.track and not footage.is_video and args.fps is None:
        problems.add("--track: images carry no time; give their frames per second with --fps.")
    if predictor and args.track and not predictor.gives_covariance:
        problems.add(f"{case.model_folder}: this model tells no covariance, which --track needs; run `train` again.")
    problems.raise_if_any()
    camera = camera or case.camera
    tracker = Tracker(TrackerSettings(predictor.encoding.centre_world_mm)) if args.track else None
    frames = []
    for i, frame in enumerate(footage):
        record = None
        with problems.collect():
            image = frame.read_rgb()
            try:
                prediction = predictor.predict(image, camera)
            except InputError as error:
                raise InputError(f"{frame.image}: {error}") from error
            record = frame_record(frame.image, prediction)
        if record:
            if frame.time_s is not None:
                record["time_s"] = round(frame.time_s, 6)
            if tracker:
                record |= tracking_record(tracker.update(frame.time_s, prediction))
            frames.append(record)
        elif footage.is_video:
            break  # every other frame has the same size
        total = max(footage.count, i + 1)
        progress((i + 1) / total, f"frame {i + 1} of {total}")
    problems.raise_if_any()
    if footage.is_video and len(frames) < 0.99 * footage.count - 1:  # files may count a frame too many
        print(f"{args.images[0]}: only {len(frames)} of its {footage.count} frames could be read; is it cut short?")
    write_poses(args.out, camera, frames, case.vessels_sha256)
    accepted = sum(frame["accepted"] for frame in frames)
    print(f"{accepted} of {len(frames)} frames accepted. Poses: {args.out}")
    if tracker:
        lost = sum(frame["tracking"]["state"] == TrackState.LOST for frame in frames)
        print(f"{len(frames) - lost} of {len(frames)} frames have a tracked pose.")
