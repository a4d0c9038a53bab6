"""The `synthesize` stage: expected appearances of a case, resumable image by image."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from .. import files
from ..case.case import Case
from ..devices import choose_device, fast_dtype
from ..errors import InputError
from ..geometry.camera import Camera
from ..masks.renderer import MaskRenderer
from ..masks.stage import craniotomy_of, parenchyma_of, read_rendered
from ..textures.library import Texture
from . import store
from .overview import overview_view
from .synthesis import Job, Synthesizer
from .vgg import SHIPPED_WEIGHTS, load_vgg


def synthesize_case(
    case: Case,
    textures: list[Texture],
    progress: Callable[[float, str], None],
    method: str = "surface",
    size_px: int = 384,
    seeds: int = 1,
    every_texture: bool = False,
    iterations: int = 50,
    weights_path: Path | None = None,
    batch: int = 1,
    device: torch.device | None = None,
) -> None:
    """Make the appearances that are not there yet.

    method `surface`: one overview per texture and seed. `image`: one image per rendered pose, textures taken in turn,
    or with `every_texture` each pose with each texture (the paper's 100 x 15).
    """
    device = device or choose_device("auto")
    vgg = load_vgg(weights_path, fast_dtype(device))
    weights_file = Path(weights_path) if weights_path else SHIPPED_WEIGHTS
    if method == "surface":
        camera, planned = _plan_surface(case, textures, size_px, seeds)
    else:
        camera, planned = _plan_images(case, textures, size_px, every_texture)
    settings = {
        "size_px": size_px,
        "iterations": iterations,
        "backbone": vgg.backbone,
        "weights_sha256": files.sha256(weights_file),
        # What the label maps depend on: an appearance on an older one is made again.
        "overview": planned[0]["camera_from_world"] if method == "surface" else None,
        "poses_sha256": files.sha256(case.poses_path) if method == "image" else None,
        "circular_field": case.manifest["stages"].get("render", {}).get("circular_field"),
    }
    folder = store.folder_of(case, method)
    files.require_space(case.folder, len(planned) * size_px**2 * 2.5e-6 + 5)
    done = _finished_items(case, method, settings)
    synthesizer = Synthesizer(vgg, device, iterations)
    digests = [_digest(texture) for texture in textures]
    for item in planned:
        item["texture_sha256"] = digests[item["texture"]]
        if done.get(item["image"], item)["texture_sha256"] != item["texture_sha256"]:
            del done[item["image"]]
    waiting = [item for item in planned if item["image"] not in done]
    case.record("synthesize", method=method, styles=sorted({t.name for t in textures}), images=len(planned), done=False)
    store.write_index(case, method, camera, settings, list(done.values()), done=False)
    finished = len(planned) - len(waiting)
    for begin in range(0, len(waiting), batch):
        part = waiting[begin : begin + batch]
        jobs = [
            Job(files.read_label_map(folder / item["labels"]), textures[item.pop("texture")], item["seed"])
            for item in part
        ]

        def report(iteration: int, at=finished, part=part) -> None:
            fraction = (at + len(part) * iteration / max(1, iterations)) / len(planned)
            progress(fraction, f"appearance {at + 1} of {len(planned)}, texture {part[0]['style']}")

        for item, (image, distance) in zip(part, synthesizer.run(jobs, report), strict=True):
            files.write_png(folder / item["image"], image)
            done[item["image"]] = item | {"gram_distance": round(distance, 5)}
        finished += len(part)
        store.write_index(case, method, camera, settings, list(done.values()), done=False)
    items = [done[item["image"]] for item in planned]
    store.write_index(case, method, camera, settings, items, done=True)
    mean_distance = float(np.mean([item["gram_distance"] for item in items]))
    case.record("synthesize", done=True, **settings, gram_distance_mean=mean_distance)


def _digest(texture: Texture) -> str:
    return hashlib.sha256(texture.image.tobytes() + texture.labels.tobytes()).hexdigest()


def _finished_items(case: Case, method: str, settings: dict) -> dict[str, dict]:
    """What an interrupted run of the same settings has finished."""
    index = store.read_index(case, method)
    if not index or index["settings"] != settings:
        return {}
    folder = store.folder_of(case, method)
    return {item["image"]: item for item in index["items"] if (folder / item["image"]).is_file()}


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

            labels = cv2.resize(labels, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
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
