"""Synthesis cut into shards: what one worker takes at a time, on this machine or on any that shares the case."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

from .. import files
from ..errors import InputError
from ..textures.library import Texture
from .claims import Claims

SHARD_IMAGES = 16
_ONE_AT_A_TIME = threading.Lock()  # a cluster's worker may run several tasks in one process; torch has its own threads


@dataclass(frozen=True)
class Recipe:
    """How every image of a run is made. weights_sha256 must be that of the weights the worker finds."""

    iterations: int
    weights_path: str | None
    weights_sha256: str
    device: str
    batch: int | None  # images optimised together; None: as memory allows


@dataclass(frozen=True)
class Shard:
    """Images of one texture. folder: the method's folder in the case, reachable by whoever works on it.

    items: per image its file name `image`, its `labels` file, `seed`, and `key`, a digest of all it depends on.
    """

    name: str
    folder: str
    texture: Texture = field(repr=False)
    items: tuple[dict, ...] = field(repr=False)

    @property
    def record_path(self) -> Path:
        return Path(self.folder) / "finished" / f"{self.name}.jsonl"

    def claims(self) -> Claims:
        return _claims(self.folder)

    def finished(self) -> dict[str, dict]:
        """Records by image, of those whose file is there as it was written."""
        found = {}
        keys = {item["image"]: item["key"] for item in self.items}
        for record in _read_lines(self.record_path):
            if keys.get(record["image"]) == record["key"]:
                found[record["image"]] = record
        return {name: record for name, record in found.items() if self._is_whole(record)}

    def _is_whole(self, record: dict) -> bool:
        path = Path(self.folder) / record["image"]
        return path.is_file() and files.sha256(path) == record["sha256"]

    def add_record(self, record: dict) -> None:
        """Append one line; the newline before it ends what a killed process may have left half-written."""
        with files.writing(self.record_path):
            self.record_path.parent.mkdir(parents=True, exist_ok=True)
            with open(self.record_path, "ab") as stream:
                stream.write(b"\n" + json.dumps(record).encode() + b"\n")


def make_shards(folder: Path, items: list[dict], textures: list[Texture], settings: dict) -> list[Shard]:
    """items name their `texture` (an index); a texture's images follow each other, so that its Grams are computed
    once and only few are in memory."""
    shards = []
    common = json.dumps(settings, sort_keys=True)
    for index, texture in enumerate(textures):
        own = []
        for item in items:
            if item["texture"] == index:
                key = hashlib.sha256(f"{common} {texture.sha256} {item['labels']} {item['seed']}".encode()).hexdigest()
                own.append({name: item[name] for name in ("image", "labels", "seed")} | {"key": key})
        for begin in range(0, len(own), SHARD_IMAGES):
            name = f"{texture.name}-{begin // SHARD_IMAGES:05d}"
            shards.append(Shard(name, str(folder), texture, tuple(own[begin : begin + SHARD_IMAGES])))
    return shards


def work_on(shard: Shard, recipe: Recipe, on_progress: Callable[[float], None] = lambda images: None) -> int | None:
    """Make the shard's images that are not there; returns how many, or None where another process is at it.

    on_progress gets the number of images done, with fractions. Raises ClaimLost, InputError.
    """
    with _ONE_AT_A_TIME:
        claim = shard.claims().take(shard.name)
        if claim is None:
            return None
        try:
            done = shard.finished()  # after the claim: another may have finished it since it was planned
            waiting = [item for item in shard.items if item["image"] not in done]
            if waiting:
                _make(shard, recipe, waiting, claim, on_progress)
            return len(waiting)
        finally:
            claim.release()


def _make(shard: Shard, recipe: Recipe, waiting: list[dict], claim, on_progress: Callable[[float], None]) -> None:
    from .synthesis import Job
    from .workload import images_at_once

    synthesizer, measure = _tools(recipe.iterations, recipe.weights_path, recipe.weights_sha256, recipe.device)
    folder = Path(shard.folder)
    batch = None
    made = 0
    while waiting:
        first = files.read_label_map(folder / waiting[0]["labels"])
        batch = batch or recipe.batch or images_at_once(first.shape, recipe.iterations, synthesizer.device)
        part, waiting = waiting[:batch], waiting[batch:]
        jobs = [Job(files.read_label_map(folder / item["labels"]), shard.texture, item["seed"]) for item in part]

        def report(share: float, made=made, part=part) -> None:
            claim.keep()
            on_progress(made + share * len(part))

        for item, job, image in zip(part, jobs, synthesizer.run(jobs, report)):
            distances = {name: round(d, 4) for name, d in measure.distances(image, job.labels, shard.texture).items()}
            claim.check()
            files.write_png(folder / item["image"], image)
            shard.add_record(
                {
                    "image": item["image"],
                    "key": item["key"],
                    "sha256": files.sha256(folder / item["image"]),
                    "gram_distance": round(sum(distances.values()), 4),
                    "gram_distance_by_class": distances,
                }
            )
        made += len(part)


@lru_cache(maxsize=8)
def _claims(folder: str) -> Claims:
    return Claims(Path(folder) / "claims")


@lru_cache(maxsize=1)
def _tools(iterations: int, weights_path: str | None, weights_sha256: str, device_name: str):
    from ..devices import choose_device, fast_dtype
    from .measure import GramMeasure
    from .synthesis import Synthesizer
    from .vgg import SHIPPED_WEIGHTS, load_vgg

    path = Path(weights_path) if weights_path else SHIPPED_WEIGHTS
    if not path.is_file() or files.sha256(path) != weights_sha256:
        raise InputError(f"{path}: not the VGG weights this run was started with; put the same file on every machine.")
    device = choose_device(device_name)
    synthesizer = Synthesizer(load_vgg(path, fast_dtype(device)), device, iterations)
    return synthesizer, GramMeasure(load_vgg(path).to(device))


def _read_lines(path: Path) -> list[dict]:
    if not path.is_file():
        return []
    found = []
    for line in path.read_bytes().split(b"\n"):
        try:
            found.append(json.loads(line))
        except ValueError:  # empty, or cut off by a kill
            continue
    return found
