"""The `train` stage: P_Omega on the case's expected appearances, resumable, its epoch chosen on an inner split."""

from __future__ import annotations

import hashlib
import logging
import math
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import torch
import torch.nn.functional as F

from .. import files
from ..appearances.store import index_path, read_appearances
from ..cancelling import cancelling_waits
from ..case.case import Case, pose_settings
from ..case.meshes import write_vtp
from ..devices import fast_dtype
from ..geometry.displacement import add_mm
from ..masks.exposed import exposed_vessels
from ..masks.stage import craniotomy_of, parenchyma_of, sampler_of
from ..registration.confidence import calibrate, calibration_error
from ..registration.contrast import SHARPER, ContrastAligner
from ..registration.covariance import CovarianceModel, calibrate_covariance, correlated, pose_error
from ..registration.decoding import EVIDENCE, PlausibleView, Reading, read_dense, read_regression
from ..registration.encoding import PoseEncoding, fit_encoding, network_camera
from ..registration.predictor import EXPOSED_VESSELS_NAME
from ..registration.refinement import VesselAligner
from . import checkpoint
from .export import export_model
from .feeder import Batch, Feeder, ViewMemory, draw_views
from .fold import Fold
from .losses import dense_loss, regression_loss, segmentation_loss
from .networks import build_network
from .presets import PAPER_EPOCHS, Preset
from .starting import SHIPPED, load_start
from .views import ViewSettings

CHECKPOINT_EVERY_S, CHECKPOINT_AT_LEAST_EVERY_S = 10.0, 45.0
CHECKPOINT_SHARE = 0.01  # of the time that a training may spend on saving itself
CALIBRATION = 8  # times as many views as for validation: one wrong one in a hundred accepted is to be counted
LEAST_CALIBRATION = 2  # where no more views were drawn in training
BENT_MORE = 2  # calibration's views than training's: brains shift farther, and more would fold them (elastic.py)
LARGEST_COUNTED_ADD_MM = 20.0  # a lost view counts as this much, however far its pose is
AVERAGE_DECAY = 0.995


def checkpoint_interval_s(took_s: float) -> float:
    """How long a training goes on until it saves itself again; took_s: what that took the last time. The quick preset's
    50 MB take some 0.05 s, on a slow disk ten times as long."""
    return min(max(CHECKPOINT_EVERY_S, took_s / CHECKPOINT_SHARE), CHECKPOINT_AT_LEAST_EVERY_S)


def train_case(
    case: Case,
    preset: Preset,
    progress: Callable[[float, str], None],
    device: torch.device,
    seed: int = 0,
    method: str | None = None,
    fold: Fold | None = None,
) -> dict:
    """Train, calibrate, export to case.model_folder; returns the validation figures that are put on record.

    Validation (inner split): poses of another seed and, with 4 textures or more, a texture that is not trained on.
    fold: train a model of a study into a folder of its own instead; the case's model and manifest stay as they are.
    """
    method, appearances = read_appearances(case, method)
    styles = fold.styles(method, appearances) if fold else sorted({a.style for a in appearances})
    inner_split = len(styles) >= 4 and (fold is None or fold.inner_texture)
    held_out = styles[len(styles) // 2 :: 8] if inner_split else []
    trained_on = [s for s in styles if s not in held_out]
    if preset.estimator == "regression" and method == "image":
        steps = math.ceil(PAPER_EPOCHS * sum(a.style in trained_on for a in appearances) / preset.batch)
        preset = replace(preset, steps=min(preset.steps, steps))
    views = ViewSettings(
        method,
        preset.size_px,
        tuple(trained_on),
        preset.fresh_poses,
        preset.negatives,
        preset.elastic_px,
        seed + 1,
        varied=preset.varied,
    )
    if fold and fold.poses_path:
        views = replace(views, poses_file=str(Path(fold.poses_path).absolute()))
    validation_views = replace(views, styles=tuple(held_out or styles), negatives=0.0, seed=seed + 1001)
    if preset.estimator == "dense":  # frames are sharper than what the network reads of them, and poses refined on them
        validation_views = replace(validation_views, size_px=SHARPER * preset.size_px)
    poses = np.stack([sampler_of(case, seed + 1).sample(i) for i in range(400)])
    encoding = fit_encoding(poses, case.vessels.centroid_mm, case.vessels.radius_mm)
    folder = fold.folder if fold else case.model_folder
    trainer = _Trainer(case, preset, encoding, device, seed, views, folder)
    progress(0.0, "rendering validation views")
    workers = max(1, _cores() - 1)
    validation = draw_views(case.folder, validation_views, preset.validation_views, workers)
    on_record = {"preset": preset.to_dict(), "seed": seed, "styles": trained_on, "held_out_styles": held_out}
    if fold is None:
        # With others, a training that is stopped would begin anew: who shows it must know.
        of = {"appearances_sha256": trainer.appearances_sha256, "poses": pose_settings(case.manifest)}
        case.record("train", **on_record, **of, done=False)
    trainer.run(validation, progress)
    drawn = trainer.state["drawn"] * preset.fresh
    count = int(np.clip(drawn, *(times * preset.validation_views for times in (LEAST_CALIBRATION, CALIBRATION))))
    progress(1.0, f"calibrating confidence on {count} views")
    bent_px = BENT_MORE * preset.elastic_px
    calibration_views = replace(validation_views, negatives=0.3, elastic_px=bent_px, seed=seed + 2001)
    calibration = draw_views(case.folder, calibration_views, count, workers)
    figures = trainer.export(calibration, validation, on_record)
    if fold is None:
        model_sha256 = files.sha256(case.model_folder / "model.onnx")
        case.record(
            "train",
            done=True,
            validation=figures,
            method=method,
            model_sha256=model_sha256,
        )
    return figures


def _cores() -> int:
    """Those that this process may use: of a shared machine's many a batch system gives a few, and memory to match."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 2


def _feeder_workers(device: torch.device) -> int:
    """Processes that render: on a CPU they share the cores with training, beside a GPU they have all but two."""
    cores = _cores()
    return max(1, cores - 2) if device.type == "cuda" else max(1, cores // 3)


def _training_threads() -> int:
    """On a CPU. Cores that render are left to that; of two it needs a small part only, so both train where they are
    real ones: two threads of one core that wait for each other cost more than they give."""
    physical = psutil.cpu_count(logical=False) or 1
    return max(_cores() - _feeder_workers(torch.device("cpu")), min(_cores(), physical, 2))


class _Trainer:
    """Network, optimiser, running average and schedule of one run."""

    def __init__(
        self,
        case: Case,
        preset: Preset,
        encoding: PoseEncoding,
        device: torch.device,
        seed: int,
        views: ViewSettings,
        folder: Path,
    ):
        self.folder = folder
        self.case, self.preset, self.encoding, self.device, self.views = case, preset, encoding, device, views
        self.camera = network_camera(case.camera, preset.size_px)
        torch.manual_seed(seed)
        network = build_network(preset.estimator, preset.size_px, preset.width, preset.reads).to(device)
        started = preset.estimator == "dense" and load_start(network)
        self.network = network.to(memory_format=torch.channels_last)
        self.optimizer = torch.optim.AdamW(
            self.network.parameters(), lr=preset.learning_rate, weight_decay=1e-4, fused=True
        )
        self.average = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.best = self.average
        craniotomy = craniotomy_of(case)
        self.exposed = exposed_vessels(case.vessels, parenchyma_of(case, craniotomy), craniotomy.outward_axis)
        self.aligner = VesselAligner(self.exposed.vertices_mm, self.exposed.triangles, self.camera)
        sharp = network_camera(case.camera, SHARPER * preset.size_px)
        self.contrast = ContrastAligner(self.exposed.vertices_mm, self.exposed.triangles, sharp)
        ranges = sampler_of(case, 0).ranges
        distance = ranges.working_distance_mm
        self.plausible = PlausibleView(
            craniotomy.centre_world_mm, craniotomy.outward_axis, ranges.tilt_max_deg, tuple(distance)
        )
        self.appearances_sha256 = files.sha256(index_path(case, views.method))
        # The poses are drawn around the craniotomy, and what a regression's numbers mean comes from the poses.
        identity = f"{preset.to_dict()} {seed} {views} {self.appearances_sha256} {ranges} {self.plausible.to_dict()}"
        identity += files.sha256(SHIPPED) if started else ""
        identity += files.sha256(Path(views.poses_file)) if views.poses_file else ""
        self.state = {
            "settings": {"sha256": hashlib.sha256(identity.encode()).hexdigest()},
            "step": 0,
            "drawn": 0,
            "seconds": 0.0,
            "best_add_mm": None,
            "curve": [],
        }

    def run(self, validation: Batch, progress: Callable[[float, str], None]) -> None:
        restored = checkpoint.load(self.folder, self.network, self.optimizer, self.state["settings"])
        if restored:
            self.average, self.best, self.state = restored
            logging.info("resuming at step %d", self.state["step"])
        state, preset = self.state, self.preset
        begin = time.monotonic() - state["seconds"]
        saved, interval_s = time.monotonic(), checkpoint_interval_s(0.0)
        if self.device.type == "cpu":
            torch.set_num_threads(_training_threads())
        segments = preset.estimator == "dense" or preset.reads != "image"
        use_bfloat16 = segments and fast_dtype(self.device) is torch.bfloat16
        recent: list[float] = []
        first = state["drawn"]
        workers = _feeder_workers(self.device)
        with Feeder(self.case.folder, self.views, preset.fresh, first, workers) as feeder, cancelling_waits() as stop:
            memory = ViewMemory(feeder, preset.batch, preset.remembered, self.views.seed)
            while True:
                done = max(state["step"] / preset.steps, state["seconds"] / 60 / preset.minutes)
                if done >= 1 or stop.asked:
                    self._save()
                    break
                batch = memory.next(state["step"])
                state["drawn"] = first + memory.drawn
                for group in self.optimizer.param_groups:
                    group["lr"] = self._learning_rate(done)
                self.network.train()
                with torch.autocast(self.device.type, torch.bfloat16, enabled=use_bfloat16):
                    output = self.network(self._images(batch.images), *self._rendered(batch))
                loss = self._loss(output, batch)
                self.optimizer.zero_grad(set_to_none=True)
                loss.backward()
                torch.nn.utils.clip_grad_norm_(self.network.parameters(), 5.0)
                self.optimizer.step()
                self._update_average(state["step"])
                state["step"] += 1
                state["seconds"] = time.monotonic() - begin
                if state["step"] % 10 == 0:
                    recent.append(float(loss.detach()))
                    shown = state["best_add_mm"]
                    text = "" if shown is None else f", validation ADD {shown:.2f} mm"
                    progress(done, f"step {state['step']}, loss {np.mean(recent[-10:]):.3f}{text}")
                if state["step"] % preset.validate_every == 0:
                    self._validate(validation, recent)
                    recent = []
                if time.monotonic() - saved > interval_s:
                    before = time.monotonic()
                    self._save()
                    saved = time.monotonic()
                    interval_s = checkpoint_interval_s(saved - before)
        if not state["curve"] or state["curve"][-1]["step"] != state["step"]:
            self._validate(validation, recent)
        self._save()

    def export(self, calibration: Batch, validation: Batch, on_record: dict) -> dict:
        """Calibrate the best network's confidence and write the model with what it was trained on; returns its
        validation figures."""
        self.network.load_state_dict(self.best)
        self.network.eval()
        readings = self._read(calibration)
        positive = calibration.surface.any(axis=(1, 2))
        errors = self._add(readings, calibration)
        good = positive & (errors < 3.0)
        usable = np.array([r.evidence is not None for r in readings])
        evidence = np.array([r.evidence for r in readings if r.evidence is not None])
        confidence = calibrate(evidence.reshape(usable.sum(), EVIDENCE[self.preset.estimator]), good[usable])
        probability = np.array([confidence.probability(r.evidence) for r in readings])
        accepted = probability >= confidence.threshold
        covariance = self._covariance(readings, calibration, positive, probability, confidence.threshold)
        shown_add = errors[accepted & positive]
        held_out_add = self._add(self._read(validation), validation)
        figures = {
            "add_mm_mean": round(float(held_out_add.mean()), 4),
            "add_mm_median": round(float(np.median(held_out_add)), 4),
            "add_below_3mm": round(float((held_out_add < 3).mean()), 4),
            "accepted_of_true": round(float(accepted[positive].mean()), 4),
            "accepted_of_false": round(float(accepted[~positive].mean()), 4) if (~positive).any() else None,
            "accepted_add_below_3mm": round(float(good[accepted].mean()), 4) if accepted.any() else None,
            "accepted_add_mm_mean": round(float(shown_add.mean()), 4) if shown_add.size else None,
            "calibration_error": round(calibration_error(probability, good), 4),
            "steps": self.state["step"],
            "seconds": round(self.state["seconds"], 1),
        }
        meta = {
            "estimator": self.preset.estimator,
            "preset": self.preset.name,
            "styles": on_record["styles"],
            "held_out_styles": on_record["held_out_styles"],
            "size_px": self.preset.size_px,
            "camera": self.case.camera.to_dict(),
            "encoding": self.encoding.to_dict(),
            "plausible_view": self.plausible.to_dict(),
            "confidence": confidence.to_dict(),
            "covariance": covariance.to_dict(),
            "validation": figures,
            "vessels_sha256": self.case.vessels_sha256,
        }
        files.write_json(self.folder / "training.json", {"curve": self.state["curve"], "validation": figures})
        write_vtp(self.folder / EXPOSED_VESSELS_NAME, self.exposed)
        export_model(self.network.cpu(), self.preset, meta, self.folder)
        return figures

    def _images(self, images_rgb: np.ndarray) -> torch.Tensor:
        images = torch.from_numpy(images_rgb).to(self.device).permute(0, 3, 1, 2).float() / 255
        return images.contiguous(memory_format=torch.channels_last)

    def _rendered(self, batch: Batch) -> tuple[torch.Tensor, ...]:
        """What a network that reads vessel masks is shown besides the image: the rendered ones."""
        if self.preset.reads == "image":
            return ()
        return (torch.from_numpy(batch.vessels).to(self.device)[:, None].float(),)

    def _loss(self, output, batch: Batch) -> torch.Tensor:
        if self.preset.reads != "image":
            logits, pose = output
            return segmentation_loss(logits, self._rendered(batch)[0]) + self._pose_loss(pose, batch)
        if self.preset.estimator == "regression":
            return self._pose_loss(output, batch)
        tensors = (torch.from_numpy(a).to(self.device) for a in (batch.points_mm, batch.surface, batch.vessels))
        return dense_loss(output, *tensors, self.encoding)

    def _pose_loss(self, output: torch.Tensor, batch: Batch) -> torch.Tensor:
        target = np.stack([self.encoding.encode(pose) for pose in batch.camera_from_world])
        return regression_loss(output, torch.from_numpy(target).float().to(self.device), self.encoding)

    def _learning_rate(self, done: float) -> float:
        """A short warm-up, then the paper's exponential decay for its network, cosine decay for the dense one."""
        first, last = self.preset.learning_rate, self.preset.final_learning_rate
        if self.preset.estimator == "regression":
            return min(1.0, (1 + self.state["step"]) / 200) * first * (last / first) ** done
        warm_up = min(1.0, 0.02 + self.state["step"] / 60)
        return warm_up * (last + (first - last) * 0.5 * (1 + math.cos(math.pi * done)))

    @torch.no_grad()
    def _update_average(self, step: int) -> None:
        decay = min(AVERAGE_DECAY, (1 + step) / (10 + step))
        values = self.network.state_dict()
        floating = [key for key, value in values.items() if value.is_floating_point()]
        torch._foreach_lerp_([self.average[key] for key in floating], [values[key] for key in floating], 1 - decay)
        for key in values.keys() - set(floating):
            self.average[key].copy_(values[key])

    @torch.no_grad()
    def _validate(self, validation: Batch, recent: list[float]) -> None:
        kept = {k: v.detach().clone() for k, v in self.network.state_dict().items()}
        self.network.load_state_dict(self.average)
        add = float(self._add(self._read(validation), validation).mean())
        self.network.load_state_dict(kept)
        loss = float(np.mean(recent)) if recent else None
        self.state["curve"].append({"step": self.state["step"], "loss": loss, "validation_add_mm": round(add, 4)})
        logging.info("step %d: loss %s, validation ADD %.3f mm", self.state["step"], loss, add)
        if self.state["best_add_mm"] is None or add < self.state["best_add_mm"]:
            self.state["best_add_mm"] = add
            self.best = {k: v.clone() for k, v in self.average.items()}

    @torch.no_grad()
    def _read(self, batch: Batch) -> list[Reading]:
        self.network.eval()
        outputs = []
        for i in range(0, len(batch.images), 32):
            images = self._images(batch.images[i : i + 32])
            if self.preset.estimator == "dense":
                images = F.avg_pool2d(images, SHARPER)
            outputs.append(self.network(images).cpu().numpy())
        outputs = np.concatenate(outputs)
        if self.preset.estimator == "regression":
            return [read_regression(output, self.encoding) for output in outputs]
        return [
            read_dense(output, image, self.camera, self.encoding, self.aligner, self.contrast)
            for output, image in zip(outputs, batch.images)
        ]

    def _add(self, readings: list[Reading], batch: Batch) -> np.ndarray:
        vertices = self.case.vessels.vertices_mm[::20]
        errors = [
            LARGEST_COUNTED_ADD_MM
            if r.camera_from_world is None
            else min(float(add_mm(vertices, true[None], r.camera_from_world[None])[0]), LARGEST_COUNTED_ADD_MM)
            for r, true in zip(readings, batch.camera_from_world)
        ]
        return np.array(errors)

    def _covariance(self, readings, batch: Batch, positive, probability, threshold: float) -> CovarianceModel:
        """From the accepted of the true views, at least the more trusted half: a refused pose is not used."""
        found = np.array([r.camera_from_world is not None for r in readings]) & positive
        least = min(threshold, np.median(probability[found])) if found.any() else threshold
        chosen = np.flatnonzero(found & (probability >= least))
        centre = self.encoding.centre_world_mm
        errors = [pose_error(batch.camera_from_world[i], readings[i].camera_from_world, centre) for i in chosen]
        none = np.zeros((6, 6))
        fits = [none if readings[i].fit is None else correlated(readings[i].fit, centre) for i in chosen]
        return calibrate_covariance(np.array(errors).reshape(-1, 6), np.array(fits).reshape(-1, 6, 6))

    def _save(self) -> None:
        checkpoint.save(self.folder, self.network, self.average, self.best, self.optimizer, self.state)
