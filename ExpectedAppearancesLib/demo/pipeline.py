"""The whole method on a generated case: every stage by the command that a user would run, in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from .. import files
from ..case.meshes import write_vtp
from ..errors import ExpectedAppearancesError, InputError
from ..geometry.camera import write_camera
from ..poses.craniotomy import find_craniotomy
from ..poses.sampling import PoseRanges, PoseSampler
from .frames import write_unseen_frames
from .vessel_tree import demo_camera, generate_case_meshes

UNSEEN_STYLES = 4
UNSEEN_FRAMES = 48
# Seeds of the test frames' poses are far from those that `render` and `train` use.
UNSEEN_SEED_OFFSET = 77_000
TILT_DEG = 50.0  # a planned craniotomy is seen from a cone around its axis; the default of `render` is wider


def run_demo(
    out: Path, progress: Callable[[float, str], None], seed: int = 0, minutes: float = 6.0, textures: int = 6
) -> dict:
    """Run all stages into `out`; returns metrics.json. Raises InputError when `out` holds something else, or a demo
    of other settings: what was made there since, a longer training or a study, is not to be deleted."""
    out = Path(out)
    marker = out / "demo.json"
    settings = {"seed": seed, "minutes": minutes, "textures": textures}
    if out.is_file():
        raise InputError(f"{out}: is a file; give a new folder with --out.")
    if out.exists() and any(out.iterdir()):
        known = marker.is_file() and files.read_json(marker, "settings of the demo")
        if not isinstance(known, dict) or not known:
            raise InputError(f"{out}: exists and is no demo; give a new folder with --out.")
        if known != settings:
            made = ", ".join(f"{name} {known.get(name)}" for name in settings)
            raise InputError(f"{out}: holds a demo of other settings ({made}); give these, or a new folder with --out.")
    files.write_json(marker, settings)

    progress(0.0, "generating a vessel tree on a curved cortex, and unseen test frames")
    vessels, cortex = generate_case_meshes(seed)
    camera = demo_camera()
    inputs, case = out / "inputs", out / "case"
    if not (inputs / "frames" / "poses.json").is_file():
        write_vtp(inputs / "vessels.vtp", vessels)
        write_vtp(inputs / "cortex.vtp", cortex)
        write_camera(inputs / "camera.json", camera)
        craniotomy = find_craniotomy(vessels, cortex)
        ranges = PoseRanges(tilt_max_deg=TILT_DEG)
        sampler = PoseSampler(craniotomy, ranges, camera, vessels.vertices_mm, seed + UNSEEN_SEED_OFFSET)
        poses = np.stack([sampler.sample(i) for i in range(UNSEEN_FRAMES)])
        write_unseen_frames(inputs / "frames", vessels, cortex, camera, poses, UNSEEN_STYLES, seed)

    known_poses = inputs / "frames" / "poses.json"
    frames = [str(known_poses.parent / f["image"]) for f in json.loads(known_poses.read_text("utf-8"))["frames"]]
    paths = ["--vessels", inputs / "vessels.vtp", "--cortex", inputs / "cortex.vtp", "--camera", inputs / "camera.json"]
    left_out = _textures_after(textures)
    stages = [
        (0.02, ["new", case, *paths]),
        (0.03, ["render", case, "--poses", 24, "--seed", seed, "--tilt-deg", TILT_DEG]),
        (0.05, ["synthesize", case, "--size", 256, *(["--exclude", *left_out] if left_out else [])]),
        (0.30, ["train", case, "--preset", "quick", "--minutes", minutes, "--seed", seed]),
        (0.92, ["register", case, *frames[:4], "--out", out / "registered.json"]),
        (0.93, ["evaluate", case, "--poses", known_poses, "--out", out / "evaluation"]),
    ]
    for fraction, command in stages:
        if command[0] == "new" and (case / "case.json").is_file():
            continue
        progress(fraction, f"{command[0]} ...")
        _run(command)
    metrics = json.loads((out / "evaluation" / "metrics.json").read_text(encoding="utf-8"))
    progress(0.98, "saving the scene")
    _save_scene(case, out)
    return metrics


def _textures_after(count: int) -> list[str]:
    from ..textures.library import read_library, shipped_textures_folder

    return [texture.name for texture in read_library(shipped_textures_folder())][count:]


def _run(command: list) -> None:
    """One command of the headless program. A process of its own, as a user's: rendering and torch stay apart."""
    arguments = [str(part) for part in command]
    done = subprocess.run([sys.executable, "-m", "ExpectedAppearancesLib", *arguments], check=False)
    if done.returncode:
        shown = " ".join(arguments[:2])
        raise ExpectedAppearancesError(f"`{shown}` ended with exit code {done.returncode}; its message is above.")


def _save_scene(case_folder: Path, out: Path) -> None:
    """The most confident accepted frame as a scene; a best view is what one opens first."""
    from ..case.case import Case
    from ..mrml.scene import save_registered_scene
    from ..registration.poses_file import read_poses

    camera, frames = read_poses(out / "evaluation" / "predicted.json")
    shown = max(
        (f for f in frames if f.camera_from_world is not None),
        key=lambda f: (bool(f.extra.get("accepted")), f.extra.get("confidence", 0.0)),
        default=None,
    )
    if shown is None:
        return
    image = files.read_image_rgb(shown.image)
    save_registered_scene(Case.open(case_folder), image, camera, shown.camera_from_world, out / "scene.mrb")
