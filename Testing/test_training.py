import contextlib
import copy
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
import torch
from cases import camera, write_inputs
from safetensors.torch import load_file

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import projection, store
from ExpectedAppearancesLib.appearances.overview import overview_view
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.errors import CancelledError, InputError
from ExpectedAppearancesLib.geometry.pose import transform
from ExpectedAppearancesLib.interpreter import library_environment
from ExpectedAppearancesLib.masks.labels import VESSELS
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.masks.stage import (
    craniotomy_of,
    parenchyma_of,
    pose_ranges_of,
    read_rendered,
    render_case,
)
from ExpectedAppearancesLib.model import checkpoint, training, views
from ExpectedAppearancesLib.model.feeder import Feeder, draw_views
from ExpectedAppearancesLib.model.losses import dense_loss, regression_loss
from ExpectedAppearancesLib.model.networks import build_network
from ExpectedAppearancesLib.model.presets import PRESETS
from ExpectedAppearancesLib.model.training import train_case
from ExpectedAppearancesLib.planning.recorded import training_state
from ExpectedAppearancesLib.poses import sampling
from ExpectedAppearancesLib.poses.sampling import PoseRanges, PoseSampler
from ExpectedAppearancesLib.registration.decoding import cell_pixels
from ExpectedAppearancesLib.registration.encoding import fit_encoding, network_camera
from ExpectedAppearancesLib.registration.poses_file import write_poses
from ExpectedAppearancesLib.registration.predictor import Predictor

CPU = torch.device("cpu")
COLOURS = np.array([[0, 0, 0], [225, 170, 160], [60, 30, 200]], np.uint8)
TINY = replace(PRESETS["quick"], size_px=64, steps=4, batch=4, fresh=2, validation_views=6, validate_every=2, width=0.4)


@pytest.fixture(scope="module")
def case(tmp_path_factory) -> Case:
    """A case whose appearances are its label maps in plain colours: what a pixel shows is known exactly."""
    folder = tmp_path_factory.mktemp("training")
    paths = write_inputs(folder)
    case = Case.create(folder / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    render_case(case, lambda *_: None, poses=4)
    craniotomy = craniotomy_of(case)
    overview, overview_pose = overview_view(craniotomy, parenchyma_of(case, craniotomy), 128)
    with MaskRenderer(case.vessels, case.cortex, overview) as renderer:
        labels = renderer.render(overview_pose)
    write_appearances(case, "surface", overview, [(labels, overview_pose)])
    rendered = [(files.read_label_map(f["labels"]), f["camera_from_world"]) for f in read_rendered(case)]
    write_appearances(case, "image", case.camera, rendered)
    return case


def write_appearances(case, method, seen_by, frames) -> None:
    folder, items = store.folder_of(case, method), []
    for i, (labels, pose) in enumerate(frames):
        files.write_png(folder / f"{i}.labels.png", labels)
        files.write_png(folder / f"{i}.png", COLOURS[labels])
        for style in "ab":
            entry = {"image": f"{i}.png", "labels": f"{i}.labels.png", "style": style, "seed": 0, "gram_distance": 0.0}
            items.append(entry | {"camera_from_world": pose.tolist()})
    store.write_index(case, method, seen_by, {}, items, done=True)


def settings(method: str, **changes) -> views.ViewSettings:
    return replace(views.ViewSettings(method, 64, ("a", "b"), True, 0.0, 0.0, seed=5), **changes)


def show_plainly(monkeypatch) -> None:
    """Views without light, lens, or anything around the surface."""
    monkeypatch.setattr(views.microscope, "apply", lambda image, _rng: image)
    monkeypatch.setattr(views, "opening", lambda *_: None)
    monkeypatch.setattr(projection.SurfacePainter, "_lit", lambda _self, image, *_: image)
    monkeypatch.setattr(projection, "DEPTH_OF_FIELD", 0.0)


def agreement(view: views.View) -> float:
    """Intersection over union of the cells that look like vessels and those said to be."""
    cells = view.image.reshape(32, 2, 32, 2, 3).mean(axis=(1, 3))
    blue = (cells[..., 2] > cells[..., 0] + 20) & (view.surface > 0)
    return (blue & (view.vessels > 0)).sum() / max(1, (blue | (view.vessels > 0)).sum())


@pytest.mark.parametrize("method", ["surface", "image"])
def test_views_show_at_each_cell_what_they_say(case, method, monkeypatch):
    """Points project onto their cells; colours and vessel cells agree, so image and geometry come from one pose."""
    show_plainly(monkeypatch)
    source = views.ViewSource(case.folder, settings(method))
    agreeing = []
    for index in range(6):
        view = source.view(index)
        flat = view.surface.ravel() > 0
        assert 0.05 < flat.mean() < 0.95
        seen = transform(view.camera_from_world, view.points_mm.reshape(-1, 3)[flat].astype(float))
        pixels = network_camera(case.camera, 64).project(seen)
        assert np.abs(pixels - cell_pixels(32)[flat]).max() < 0.35
        agreeing.append(agreement(view))
    source.close()
    assert np.mean(agreeing) > 0.6  # vessels are about two cells wide: edges cost the rest


def test_near_views_show_the_vessels_as_they_are_where_poses_may_be_far_too(case, tmp_path):
    """Triangles for the farthest views of a wide range, 60 to 600 mm, left stumps of the vessels in the near ones."""
    wide = Case.open(shutil.copytree(case.folder, tmp_path / "case"))
    wide.record("render", ranges=replace(pose_ranges_of(case), working_distance_mm=(60.0, 600.0)).to_dict())
    near = PoseSampler(
        craniotomy_of(case), PoseRanges(working_distance_mm=(60, 70)), camera(), case.vessels.vertices_mm
    )
    frames = [{"image": f"{i}.png", "camera_from_world": near.sample(i)} for i in range(3)]
    write_poses(tmp_path / "near.json", camera(), frames)
    source = views.ViewSource(wide.folder, settings("surface", poses_file=str(tmp_path / "near.json")))
    with MaskRenderer(case.vessels, case.cortex, network_camera(case.camera, 64)) as renderer:
        for index in range(3):
            view = source.view(index)
            exact = renderer.render(view.camera_from_world).reshape(32, 2, 32, 2)
            exact = ((exact == VESSELS).mean(axis=(1, 3)) >= 0.5) & (view.surface > 0)
            drawn = (view.vessels > 0) & (view.surface > 0)
            assert (exact & drawn).sum() / (exact | drawn).sum() > 0.75
    source.close()


def test_training_starts_at_the_shipped_weights_and_asks_for_them_when_it_goes_on(case, tmp_path, monkeypatch):
    """Other weights at the start are another training: a checkpoint of the old one is not continued."""
    from ExpectedAppearancesLib.model import starting, training

    preset = replace(PRESETS["quick"], size_px=64)

    def trainer():
        encoding = fit_encoding(np.stack([np.eye(4)] * 3), case.vessels.centroid_mm, case.vessels.radius_mm)
        return training._Trainer(case, preset, encoding, CPU, 0, settings("surface"), tmp_path)

    first = trainer()
    shipped = load_file(str(starting.SHIPPED))
    for state in (first.network.state_dict(), first.average, first.best):
        assert torch.equal(state["down2.0.0.weight"], shipped["down2.0.0.weight"].float())
    monkeypatch.setattr(training, "load_start", lambda _network: False)
    assert trainer().state["settings"] != first.state["settings"]


def test_a_training_begins_anew_where_the_craniotomy_was_moved(case, tmp_path):
    """The appearances stay as they are where only its centre moved, since they show all of the surface: a finished
    training would count as one on the poses around the new centre."""
    moved = Case(case.folder, copy.deepcopy(case.manifest), case.camera)
    moved.manifest["stages"]["render"]["craniotomy"]["centre_world_mm"][0] += 8.0
    encoding = fit_encoding(np.stack([np.eye(4)] * 3), case.vessels.centroid_mm, case.vessels.radius_mm)
    first, same, other = (
        training._Trainer(one, TINY, encoding, CPU, 0, settings("surface"), tmp_path).state["settings"]
        for one in (case, case, moved)
    )
    assert first == same != other


def test_a_training_begins_anew_where_the_poses_that_it_repeats_were_changed(case, tmp_path):
    """In their file, whose name stays: `train --poses` called a finished model of the old ones that of the new."""
    from ExpectedAppearancesLib.model import training

    repeated = settings("surface", poses_file=str(tmp_path / "known.json"))
    encoding = fit_encoding(np.stack([np.eye(4)] * 3), case.vessels.centroid_mm, case.vessels.radius_mm)
    states = []
    for count in (3, 3, 2):
        frames = [{"image": f"{i}.png", "camera_from_world": np.eye(4)} for i in range(count)]
        write_poses(tmp_path / "known.json", camera(), frames)
        trainer = training._Trainer(case, TINY, encoding, CPU, 0, repeated, tmp_path)
        states.append(trainer.state["settings"])
    assert states[0] == states[1] != states[2]


def test_views_depend_only_on_seed_and_index_and_have_poses_of_their_own(case):
    first = views.ViewSource(case.folder, settings("surface"))
    again = views.ViewSource(case.folder, settings("surface"))
    first.view(0)
    one, two = first.view(3), again.view(3)
    np.testing.assert_array_equal(one.image, two.image)
    assert np.abs(one.camera_from_world - first.view(4).camera_from_world).max() > 1e-3
    paper = views.ViewSource(case.folder, settings("image", fresh_poses=False))
    stored = [frame["camera_from_world"] for frame in read_rendered(case)]
    assert all(min(np.abs(paper.view(i).camera_from_world - p).max() for p in stored) < 1e-12 for i in range(5))


@pytest.mark.parametrize("method", ["surface", "image"])
def test_the_papers_views_are_what_was_synthesised_and_nothing_else(case, method):
    shares = []
    for varied in (False, True):
        source = views.ViewSource(case.folder, settings(method, fresh_poses=False, varied=varied))
        pixels = np.concatenate([source.view(i).image.reshape(-1, 3) for i in range(4)]).astype(int)
        source.close()
        shares.append([(np.abs(pixels - colour).max(axis=1) <= 2).mean() for colour in COLOURS.astype(int)])
    assert sum(shares[0]) > 0.85 > 0.5 > sum(shares[1]), shares
    assert min(shares[0]) > 0.02


def test_a_view_for_which_no_pose_is_found_does_not_end_a_training(case, monkeypatch):
    """Where the vessels are mostly wider than the view, all of a hundred poses are found, and not of thousands."""
    source = views.ViewSource(case.folder, settings("surface"))
    ranges = replace(source._sampler.ranges, in_view_min=0.95)
    args = (source._sampler.craniotomy, ranges, case.camera, case.vessels.vertices_mm, 5)
    source._sampler = PoseSampler(*args)
    monkeypatch.setattr(sampling, "MAX_TRIES", 1)

    def found(index: int) -> bool:
        with contextlib.suppress(InputError):
            return source._sampler.sample(index) is not None
        return False

    none_for = next(i for i in range(1, 200) if found(i - 1) and not found(i))
    np.testing.assert_array_equal(source.view(none_for).camera_from_world, source._sampler.sample(none_for - 1))
    assert (source.view(none_for).image != source.view(none_for - 1).image).any()
    source.close()


def test_processes_that_draw_in_turn_draw_what_one_draws(case):
    drawn = []
    for workers in (1, 3):
        with Feeder(case.folder, settings("surface"), 2, first_batch=1, workers=workers) as feeder:
            drawn.append([feeder.next().images for _ in range(4)])
    np.testing.assert_array_equal(*drawn)
    source = views.ViewSource(case.folder, settings("surface"))
    np.testing.assert_array_equal(drawn[0][1][1], source.view(5).image)
    np.testing.assert_array_equal(draw_views(case.folder, settings("surface"), 18).images[17], source.view(17).image)


def test_negative_views_have_no_surface(case):
    source = views.ViewSource(case.folder, settings("surface", negatives=1.0))
    drawn = [source.view(i) for i in range(8)]
    assert not any(view.surface.any() or view.vessels.any() for view in drawn)
    assert all(view.image.std() > 0 for view in drawn)


def test_elastic_deformation_takes_the_points_along(case, monkeypatch):
    show_plainly(monkeypatch)
    straight = views.ViewSource(case.folder, settings("surface"))
    bent = views.ViewSource(case.folder, settings("surface", elastic_px=6.0))
    pairs = [(straight.view(i), bent.view(i)) for i in range(6)]
    assert any((a.points_mm != b.points_mm).any() for a, b in pairs)
    assert np.mean([agreement(b) for _, b in pairs]) > 0.6


def test_the_pose_of_a_bent_view_is_the_one_that_fits_what_is_seen(case, monkeypatch):
    """The bending moves the tissue in view: of its old pose a view would say that the best possible one is wrong."""
    show_plainly(monkeypatch)
    straight = views.ViewSource(case.folder, settings("surface"))
    bent = views.ViewSource(case.folder, settings("surface", elastic_px=6.0))
    camera = network_camera(case.camera, 64)
    moved = []
    for index in range(6):
        before, view = straight.view(index).camera_from_world, bent.view(index)
        flat = view.surface.ravel() > 0
        points_mm, cells_px = view.points_mm.reshape(-1, 3)[flat].astype(float), cell_pixels(32)[flat]
        rms_px = [
            np.sqrt(np.square(camera.project(transform(pose, points_mm)) - cells_px).sum(axis=1).mean())
            for pose in (before, view.camera_from_world)
        ]
        assert rms_px[1] < rms_px[0]
        moved.append(rms_px[0] - rms_px[1])
    assert max(moved) > 0.05


def test_losses_against_plain_formulas():
    rng = np.random.default_rng(0)
    poses = np.stack([np.eye(4)] * 3)
    poses[:, :3, 3] = rng.normal(size=(3, 3)) * 10 + [0, 0, 100]
    encoding = fit_encoding(poses, np.array([1.0, 2.0, 3.0]), 20.0)
    output, target = rng.normal(size=(2, 6)), rng.normal(size=(2, 6))
    plain = np.mean(
        [
            np.linalg.norm((o[3:] - t[3:]) * encoding.translation_scale_mm) + np.linalg.norm(o[:3] - t[:3])
            for o, t in zip(output, target, strict=True)
        ]
    )
    assert regression_loss(torch.tensor(output), torch.tensor(target), encoding).item() == pytest.approx(plain)
    points = torch.tensor(rng.normal(size=(1, 4, 4, 3)) * 5, dtype=torch.float32)
    surface = torch.tensor(rng.integers(0, 2, (1, 4, 4)), dtype=torch.uint8)
    perfect = torch.zeros(1, 6, 4, 4)
    perfect[:, :3] = ((points - torch.tensor([1.0, 2.0, 3.0])) / 20).permute(0, 3, 1, 2)
    perfect[:, 3], perfect[:, 5] = -5, -9
    perfect[:, 4] = 18 * surface.float() - 9
    no_vessels = torch.zeros_like(surface)
    best = dense_loss(perfect, points, surface, no_vessels, encoding)
    assert best.item() == pytest.approx(-15, abs=0.05)
    # What the network says where there is no surface must not matter.
    elsewhere = perfect.clone()
    elsewhere[:, :4] += 3 * (1 - surface.float())[:, None]
    torch.testing.assert_close(dense_loss(elsewhere, points, surface, no_vessels, encoding), best)
    worse = perfect.clone()
    worse[:, 0] += 0.5
    assert dense_loss(worse, points, surface, no_vessels, encoding) > best + 1


def test_paper_network_is_the_papers():
    network = build_network("regression", 128, 1.0)
    kinds = [type(layer).__name__ for layer in network.features]
    block = ["Conv2d", "Conv2d", "ReLU"]
    assert kinds == [*block, "AvgPool2d", *block, "AvgPool2d", *block]
    assert [layer.out_features for layer in network.head if hasattr(layer, "out_features")] == [128, 64, 32, 6]
    preset = PRESETS["paper"]
    assert (preset.batch, preset.learning_rate, preset.final_learning_rate) == (8, 1e-3, 1e-4)


def test_paper_network_learns_from_views_that_differ():
    """It had PyTorch's usual initial weights: all that it did in thousands of steps was to lose its ReLUs."""
    torch.manual_seed(0)
    side, preset = 32, PRESETS["paper"]
    network = build_network("regression", side, 1.0)
    optimizer = torch.optim.AdamW(network.parameters(), lr=preset.learning_rate)
    encoding, rows, losses = SimpleNamespace(translation_scale_mm=20.0), torch.arange(side), []
    for _ in range(200):
        images = 0.3 * torch.rand(8, 3, side, side) + 0.5 * torch.rand(8, 3, 1, 1)
        place = 0.6 * torch.rand(8, 2) + 0.2
        away = rows[None] - side * place[..., None]
        blob = torch.exp(-(away[:, 0, :, None].square() + away[:, 1, None].square()) / 8)[:, None]
        target = torch.cat([torch.zeros(8, 3), 4 * (place - 0.5), torch.randn(8, 1)], dim=1)
        loss = regression_loss(network(images * (1 - blob) + 0.1 * blob), target, encoding)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert np.mean(losses[-30:]) < 0.75 * np.mean(losses[:30])


@pytest.fixture(scope="module")
def trained(case) -> Case:
    calls = []

    def kill_after_three(fraction, _message):
        calls.append(fraction)

    train_case(case, TINY, kill_after_three, CPU, method="surface")
    assert calls == sorted(calls)
    return case


def test_trained_model_registers_frames_of_any_size_and_colour(trained, tmp_path):
    meta = json.loads((trained.model_folder / "model.json").read_text())
    assert meta["export_difference"] < 1e-4 and meta["validation"]["steps"] == 4
    predictor = Predictor(trained.model_folder)
    for shape in ((96, 96, 3), (500, 500, 3), (41, 41, 3)):
        prediction = predictor.predict(np.random.default_rng(0).integers(0, 255, shape).astype(np.uint8), camera())
        assert 0 <= prediction.confidence <= 1 and prediction.latency_ms > 0 and not prediction.accepted
    files.write_png(tmp_path / "ä b.png", np.zeros((96, 96), np.uint8))
    out = tmp_path / "poses.json"
    assert main(["register", str(trained.folder), str(tmp_path / "ä b.png"), "--out", str(out)]) == 0
    frame = json.loads(out.read_text())["frames"][0]
    assert frame["image"] == "ä b.png" and frame["accepted"] is False
    assert {"confidence", "rotation_vector_rad", "translation_mm", "latency_ms", "camera_from_world"} <= frame.keys()
    assert meta["covariance"].keys() == {"shared", "scale"} and "covariance" in frame


def test_every_bad_frame_is_listed_and_nothing_is_written(trained, tmp_path, capsys):
    files.write_png(tmp_path / "wide.png", np.zeros((50, 96), np.uint8))
    (tmp_path / "cut.png").write_bytes(b"\x89PNG")
    out = tmp_path / "poses.json"
    code = main(
        ["register", str(trained.folder), str(tmp_path / "wide.png"), str(tmp_path / "cut.png"), "--out", str(out)]
    )
    text = capsys.readouterr().err
    assert code == 2 and "wide.png" in text and "cut.png" in text and "aspect" in text and not out.exists()


def test_training_is_on_record_with_seeds_styles_and_curve(trained):
    entry = json.loads((trained.folder / "case.json").read_text())["stages"]["train"]
    assert entry["done"] and entry["seed"] == 0 and entry["styles"] == ["a", "b"]
    assert entry["appearances_sha256"] == files.sha256(store.folder_of(trained, "surface") / "index.json")
    assert entry["poses"]["craniotomy"]["centre_world_mm"] == pytest.approx(trained.vessels.centroid_mm)
    assert entry["model_sha256"] == files.sha256(trained.model_folder / "model.onnx")
    curve = json.loads((trained.model_folder / "training.json").read_text())["curve"]
    assert [point["step"] for point in curve] == [2, 4] and all(p["validation_add_mm"] >= 0 for p in curve)


def test_a_stopped_training_goes_on_from_its_checkpoint(trained, monkeypatch):
    monkeypatch.setattr(training, "checkpoint_interval_s", lambda _took_s: 0.0)
    preset = replace(TINY, steps=6)
    saves = []
    original = training._Trainer._save

    def cancel_after_second(self):
        original(self)
        saves.append(self.state["step"])
        if len(saves) == 2:
            raise CancelledError("stop")

    monkeypatch.setattr(training._Trainer, "_save", cancel_after_second)
    before = threading.active_count()
    with pytest.raises(CancelledError):
        train_case(trained, preset, lambda *_: None, CPU, seed=9, method="surface")
    figures = train_case(trained, preset, lambda *_: None, CPU, seed=9, method="surface")
    assert saves[:3] == [1, 2, 3] and figures["steps"] == 6
    assert threading.active_count() <= before + 1


def test_saving_costs_a_hundredth_of_the_time_and_a_kill_loses_a_bounded_time():
    from ExpectedAppearancesLib.model.training import checkpoint_interval_s

    assert checkpoint_interval_s(0.0) == checkpoint_interval_s(0.05) == 10.0
    assert checkpoint_interval_s(0.3) == pytest.approx(30.0)
    assert checkpoint_interval_s(20.0) == 45.0  # on the slowest disk


# A training that saves nothing on its own, and notes every step that it has done.
STEPPER = """
import sys
from dataclasses import replace
from types import SimpleNamespace
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.model import presets, training

usual = training._Trainer._update_average

def noted(self, step):
    usual(self, step)
    with open(sys.argv[2], "a") as stream:
        print(step + 1, file=stream)

if __name__ == "__main__":
    training.checkpoint_interval_s = lambda took_s: 1e9
    training._Trainer._update_average = noted
    small = {"size_px": 64, "batch": 4, "fresh": 2, "validation_views": 6, "width": 0.4}
    presets.PRESETS["quick"] = replace(presets.PRESETS["quick"], steps=10**6, validate_every=10**6, **small)
    sys.exit(main(["train", sys.argv[1], "--device", "cpu", "--appearances", "surface", "--seed", "11"]))
"""


@pytest.mark.skipif(os.name == "nt", reason="signals")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_cancelled_training_loses_no_step(case, tmp_path, number):
    (tmp_path / "stepper.py").write_text(STEPPER)
    path = case.model_folder / "checkpoint.safetensors"
    path.unlink(missing_ok=True)

    def steps() -> list[int]:
        noted = tmp_path / "steps.txt"
        return [int(line) for line in noted.read_text().split()] if noted.is_file() else []

    for wanted in (5, 12):
        process = subprocess.Popen(
            [sys.executable, str(tmp_path / "stepper.py"), str(case.folder), str(tmp_path / "steps.txt")],
            env=library_environment(),
        )
        try:
            deadline = time.monotonic() + 300
            while len(steps()) < wanted and process.poll() is None and time.monotonic() < deadline:
                time.sleep(0.02)
            process.send_signal(number)
            assert process.wait(120) == 3
        finally:
            process.kill()
        assert len(steps()) >= wanted and training_state(path)["step"] == steps()[-1]
    assert steps() == list(range(1, len(steps()) + 1))  # none again, none left out


# Draws views until nobody takes any more, and says who draws them.
DRAWER = """
import sys, time
from ExpectedAppearancesLib.model.feeder import Feeder
from ExpectedAppearancesLib.model.views import ViewSettings

if __name__ == "__main__":
    settings = ViewSettings("surface", 64, ("a", "b"), True, 0.0, 0.0, 5)
    with Feeder(sys.argv[1], settings, 1) as feeder:
        while not feeder._queues[0].full():
            time.sleep(0.02)
        print(feeder._processes[0].pid, flush=True)
        time.sleep(600)
"""


def test_views_are_drawn_for_nobody_once_their_training_is_killed(case, tmp_path):
    (tmp_path / "drawer.py").write_text(DRAWER)
    command = [sys.executable, str(tmp_path / "drawer.py"), str(case.folder)]
    process = subprocess.Popen(command, env=library_environment(), stdout=subprocess.PIPE, text=True)
    drawing = psutil.Process(int(process.stdout.readline()))
    process.kill()
    process.wait()
    try:
        drawing.wait(120)
    finally:
        with contextlib.suppress(psutil.NoSuchProcess):
            drawing.kill()


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_ctrl_c_leaves_a_training_the_views_of_the_step_it_is_in(case):
    """In a terminal it reaches the processes that draw, too."""
    with Feeder(case.folder, settings("surface"), 1) as feeder:
        feeder.next()
        os.kill(feeder._processes[0].pid, signal.SIGINT)
        assert len([feeder.next() for _ in range(20)]) == 20  # more than had been drawn by then


def test_a_damaged_checkpoint_is_not_gone_on_from(trained):
    path = trained.model_folder / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert train_case(trained, replace(TINY, steps=2), lambda *_: None, CPU, method="surface")["steps"] == 2


@pytest.mark.skipif(not hasattr(psutil.Process, "memory_maps"), reason="this system does not tell what is mapped")
def test_a_training_that_goes_on_holds_nothing_of_its_checkpoint(tmp_path):
    """Windows replaces no file that is mapped into memory: the next checkpoint could not be written."""
    network = torch.nn.Linear(3, 2)
    optimizer = torch.optim.AdamW(network.parameters())
    network(torch.ones(1, 3)).sum().backward()
    optimizer.step()
    weights = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    checkpoint.save(tmp_path, network, weights, weights, optimizer, {"settings": {}})
    average, _best, _state = checkpoint.load(tmp_path, network, optimizer, {})
    torch.testing.assert_close(average, weights)
    mapped = [area.path for area in psutil.Process().memory_maps()]
    assert not [path for path in mapped if "checkpoint.safetensors" in path]


@pytest.mark.skipif(os.name == "nt", reason="Windows has no limit for the size of files")
def test_a_checkpoint_that_does_not_fit_on_the_disk_is_told_in_words(tmp_path):
    """The library that writes it has an error of its own for that, which names no file and no way out."""
    network = torch.nn.Linear(300, 300)
    optimizer = torch.optim.AdamW(network.parameters())
    import resource

    usual = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(InputError, match=r"checkpoint\.safetensors: cannot be written .*free some space"):
            checkpoint.save(tmp_path, network, {}, {}, optimizer, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, usual)
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="this system gives no process a part of the cores")
def test_processes_that_render_are_no_more_than_the_cores_that_training_was_given(monkeypatch):
    """Four of a machine's 128, say: 127 processes, each with its meshes and appearances, do not fit in their memory."""
    monkeypatch.setattr(os, "cpu_count", lambda: 128)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _process: {7, 8, 9, 10})
    assert training._feeder_workers(CPU) == 1 and training._feeder_workers(torch.device("cuda")) == 2


def test_training_without_appearances_says_what_to_run(tmp_path):
    paths = write_inputs(tmp_path)
    bare = Case.create(tmp_path / "case", paths["vessels.vtp"], None, paths["camera.json"])
    with pytest.raises(InputError, match="run `synthesize` first"):
        train_case(bare, TINY, lambda *_: None, CPU)


@pytest.mark.parametrize(("cores", "physical", "threads"), [(1, 1, 1), (1, 8, 1), (2, 1, 1), (2, 2, 2), (9, 9, 6)])
def test_both_of_two_real_cores_train(monkeypatch, cores, physical, threads):
    monkeypatch.setattr(training, "_cores", lambda: cores)
    monkeypatch.setattr(psutil, "cpu_count", lambda logical: physical)
    assert training._training_threads() == threads
