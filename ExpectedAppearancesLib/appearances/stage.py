"""The `synthesize` stage: expected appearances of a case, resumable image by image, by one process or many."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from .. import files
from ..case.case import Case
from ..devices import choose_device
from ..errors import InputError
from ..executor import LOCAL, check_executor
from ..geometry.camera import Camera
from ..masks.renderer import MaskRenderer
from ..masks.stage import craniotomy_of, parenchyma_of, read_rendered
from ..textures.library import Texture
from . import store
from .dispatch import run_shards
from .overview import overview_view
from .shards import Recipe, make_shards
from .vgg import SHIPPED_WEIGHTS, load_vgg
from .workload import DEFAULT_ITERATIONS


def synthesize_case(
    case: Case,
    textures: list[Texture],
    progress: Callable[[float, str], None],
    method: str = "surface",
    size_px: int = 384,
    seeds: int = 1,
    every_texture: bool = False,
    iterations: int = DEFAULT_ITERATIONS,
    weights_path: Path | None = None,
    batch: int | None = None,
    device: torch.device | None = None,
    executor: str = LOCAL,
) -> dict[str, float]:
    """Make the appearances that are not there yet; returns the mean Gram distance by class (GramMeasure).

    method `surface`: one overview per texture and seed. `image`: one image per rendered pose, textures taken in turn,
    or with `every_texture` each pose with each texture (the paper's 100 x 15).
    batch: images optimised together, None as memory allows. executor: `local` or `dask://HOST:PORT`.
    """
    check_executor(executor)
    device = device or choose_device("auto")
    backbone = load_vgg(weights_path).backbone
    weights_file = Path(weights_path or SHIPPED_WEIGHTS).absolute()
    if method == "surface":
        camera, planned = _plan_surface(case, textures, size_px, seeds)
    else:
        camera, planned = _plan_images(case, textures, size_px, every_texture)
    settings = {
        "size_px": size_px,
        "iterations": iterations,
        "backbone": backbone,
        "weights_sha256": files.sha256(weights_file),
        # What the label maps depend on: an appearance on an older one is made again.
        "overview": planned[0]["camera_from_world"] if method == "surface" else None,
        "poses_sha256": files.sha256(case.poses_path) if method == "image" else None,
        "circular_field": case.manifest["stages"].get("render", {}).get("circular_field"),
    }
    folder = store.folder_of(case, method)
    digests = [texture.sha256 for texture in textures]
    for item in planned:
        item["texture_sha256"] = digests[item["texture"]]  # by which a panel sees that a texture has changed
    files.require_space(case.folder, len(planned) * size_px**2 * 2.5e-6 + 5)
    shards = make_shards(folder, planned, textures, settings)
    case.record("synthesize", method=method, styles=sorted({t.name for t in textures}), images=len(planned), done=False)
    store.write_index(case, method, camera, settings, [], done=False)
    recipe = Recipe(
        iterations, str(weights_file) if weights_path else None, settings["weights_sha256"], device.type, batch
    )

    def report(images: float, name: str) -> None:
        text = f"appearance {max(1, math.ceil(round(images, 3)))} of {len(planned)}, {name}"
        progress(min(1.0, images / len(planned)), text)

    run_shards(shards, recipe, executor, report)
    items = _finished_items(planned, shards)
    store.write_index(case, method, camera, settings, items, done=True)
    by_class = mean_distances(items)
    total = round(sum(by_class.values()), 4)
    case.record("synthesize", done=True, **settings, gram_distance_mean=total, gram_distance_by_class=by_class)
    return by_class


def _finished_items(planned: list[dict], shards: list) -> list[dict]:
    """What the index says of each appearance, once all are finished."""
    made = {}
    for shard in shards:
        made.update(shard.finished())
    figures = ("gram_distance", "gram_distance_by_class")
    return [
        {name: value for name, value in item.items() if name != "texture"}
        | {name: made[item["image"]][name] for name in figures}
        for item in planned
    ]


def mean_distances(items: list[dict]) -> dict[str, float]:
    """Mean of `gram_distance_by_class` over the items that show the class."""
    found: dict[str, list[float]] = {}
    for item in items:
        for name, distance in item["gram_distance_by_class"].items():
            found.setdefault(name, []).append(distance)
    return {name: round(float(np.mean(values)), 4) for name, values in found.items()}


def _plan_surface(case: Case, textures: list[Texture], size_px: int, seeds: int) -> tuple[Camera, list[dict]]:
    craniotomy = craniotomy_of(case)
    parenchyma = parenchyma_of(case, craniotomy)
    camera, camera_from_world = overview_view(craniotomy, parenchyma, size_px)
    with MaskRenderer(case.vessels, parenchyma, camera) as renderer:
        labels = renderer.render(camera_from_world)
    files.write_png(store.folder_of(case, "surface") / "overview.labels.png", labels)
    planned = [
        {
            "image": f"{texture.name}-{seed}.png",
            "labels": "overview.labels.png",
            "style": texture.name,
            "seed": seed,
            "texture": t,
            "camera_from_world": camera_from_world.tolist(),
        }
        for seed in range(seeds)
        for t, texture in enumerate(textures)
    ]
    return camera, planned


def _plan_images(case: Case, textures: list[Texture], size_px: int, every_texture: bool) -> tuple[Camera, list[dict]]:
    scale = size_px / case.camera.height
    camera = case.camera.without_distortion().resized(round(case.camera.width * scale), size_px)
    folder = store.folder_of(case, "image")
    planned = []
    for i, frame in enumerate(read_rendered(case)):
        labels = files.read_label_map(frame["labels"])
        if labels.shape != (camera.height, camera.width):
            import cv2

            # The exact one: the other takes a pixel's upper left corner for its centre, half a pixel beside the pose.
            labels = cv2.resize(labels, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST_EXACT)
        files.write_png(folder / f"{i:05d}.labels.png", labels)
        for t in range(len(textures)) if every_texture else [i % len(textures)]:
            planned.append(
                {
                    "image": f"{i:05d}-{textures[t].name}.png",
                    "labels": f"{i:05d}.labels.png",
                    "style": textures[t].name,
                    "seed": i,
                    "texture": t,
                    "camera_from_world": frame["camera_from_world"].tolist(),
                }
            )
    if not planned:
        raise InputError(f"{case.folder}: no label maps to synthesise on; run `render` first.")
    return camera, planned
