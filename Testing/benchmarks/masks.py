"""Label maps per second with one window kept, beside a window made for every map."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from ExpectedAppearancesLib.case.meshes import read_mesh
from ExpectedAppearancesLib.geometry.camera import read_camera
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy
from ExpectedAppearancesLib.poses.sampling import PoseRanges, PoseSampler

MAPS, ROUNDS = 40, 3


def measure(inputs: Path) -> dict:
    """{"masks": {...}}; rounds alternate."""
    vessels, cortex = (read_mesh(inputs / f"{name}.vtp", f"{name} mesh") for name in ("vessels", "cortex"))
    camera = read_camera(inputs / "camera.json")
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
        "masks": {
            "maps_per_s": round(float(np.median(kept)), 1),
            "reference_maps_per_s": round(float(np.median(fresh)), 1),
            "ratio": round(float(np.median(ratios)), 2),
            "size_px": [camera.width, camera.height],
        }
    }
