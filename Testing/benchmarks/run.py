"""Measure stages beside plain references, in one run, into build/benchmark.json: ratios hold where times do not."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from ExpectedAppearancesLib.case.meshes import Mesh, read_mesh
from ExpectedAppearancesLib.demo.vessel_tree import demo_camera, generate_case_meshes
from ExpectedAppearancesLib.geometry.camera import Camera, read_camera
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy
from ExpectedAppearancesLib.poses.sampling import PoseRanges, PoseSampler

MAPS = 40
ROUNDS = 3


def measure_masks(vessels: Mesh, cortex: Mesh, camera: Camera) -> dict:
    """Label maps per second with one window kept, against a window made for every map; rounds alternate."""
    sampler = PoseSampler(find_craniotomy(vessels, cortex), PoseRanges(), camera, vessels.vertices_mm)
    poses = [sampler.sample(i) for i in range(MAPS)]
    kept, fresh = [], []
    for _ in range(ROUNDS):
        with MaskRenderer(vessels, cortex, camera) as renderer:
            renderer.render(poses[0])
            begin = time.perf_counter()
            for pose in poses:
                renderer.render(pose)
            kept.append(MAPS / (time.perf_counter() - begin))
        begin = time.perf_counter()
        for pose in poses[: MAPS // 4]:
            with MaskRenderer(vessels, cortex, camera) as renderer:
                renderer.render(pose)
        fresh.append(MAPS // 4 / (time.perf_counter() - begin))
    ratios = np.array(kept) / np.array(fresh)
    return {
        "maps_per_s": round(float(np.median(kept)), 1),
        "reference_maps_per_s": round(float(np.median(fresh)), 1),
        "ratio": round(float(np.median(ratios)), 2),
        "size_px": [camera.width, camera.height],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--inputs", type=Path, metavar="DIR", help="vessels.vtp, cortex.vtp, camera.json; else generated"
    )
    parser.add_argument("--out", type=Path, default=Path("build/benchmark.json"))
    args = parser.parse_args()
    if args.inputs:
        vessels, cortex = (read_mesh(args.inputs / f"{name}.vtp", f"{name} mesh") for name in ("vessels", "cortex"))
        camera = read_camera(args.inputs / "camera.json")
    else:
        vessels, cortex = generate_case_meshes(0)
        camera = demo_camera()
    result = {"masks": measure_masks(vessels, cortex, camera)}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
