"""Training views of 256 px drawn on the surface: views/s of all cores, beside one process that keeps nothing.

What an appearance shows does not change what laying it on the surface costs: noise stands in for textures.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import store
from ExpectedAppearancesLib.appearances.overview import overview_view
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.masks.stage import craniotomy_of, parenchyma_of, render_case
from ExpectedAppearancesLib.model.feeder import Feeder
from ExpectedAppearancesLib.model.views import ViewSettings, ViewSource

SIZE_PX, OVERVIEW_PX, BATCH, ROUNDS = 256, 384, 8, 25


def measure(inputs: Path) -> dict:
    """{"surface_views_per_s", "surface_views_ratio"}: all cores kept busy against a new source for each view."""
    with tempfile.TemporaryDirectory() as folder:
        case = Case.create(Path(folder) / "case", inputs / "vessels.vtp", inputs / "cortex.vtp", inputs / "camera.json")
        render_case(case, lambda *_: None, poses=1)
        _write_noise(case)
        settings = ViewSettings("surface", SIZE_PX, ("a", "b"), True, 0.06, 2.0, seed=1)
        workers = os.cpu_count() or 1
        with Feeder(case.folder, settings, BATCH, workers=workers) as feeder:
            for _ in range(8 * workers):  # past the start, and past what waited in the queues
                feeder.next()
            begin = time.perf_counter()
            for _ in range(ROUNDS):
                feeder.next()
            kept = ROUNDS * BATCH / (time.perf_counter() - begin)
        begin = time.perf_counter()
        for i in range(4):
            source = ViewSource(case.folder, settings)
            source.view(i)
            source.close()
        anew = 4 / (time.perf_counter() - begin)
    return {"surface_views_per_s": round(kept, 1), "surface_views_ratio": round(kept / anew, 1)}


def _write_noise(case: Case) -> None:
    craniotomy = craniotomy_of(case)
    camera, pose = overview_view(craniotomy, parenchyma_of(case, craniotomy), OVERVIEW_PX)
    with MaskRenderer(case.vessels, case.cortex, camera) as renderer:
        labels = renderer.render(pose)
    folder, rng, items = store.folder_of(case, "surface"), np.random.default_rng(0), []
    files.write_png(folder / "labels.png", labels)
    for style in "ab":
        files.write_png(folder / f"{style}.png", rng.integers(0, 256, (*labels.shape, 3), np.uint8))
        items.append({"image": f"{style}.png", "labels": "labels.png", "style": style, "seed": 0, "gram_distance": 0.0})
        items[-1]["camera_from_world"] = pose.tolist()
    store.write_index(case, "surface", camera, {}, items, done=True)
