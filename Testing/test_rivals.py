"""Models of a study (folds), and the paper's rivals, which segment vessels before they regress the pose."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from cases import camera
from test_training import CPU, TINY, case, settings  # noqa: F401 (case is a fixture)

from ExpectedAppearancesLib.appearances.store import read_appearances
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.masks.stage import read_rendered
from ExpectedAppearancesLib.model import views
from ExpectedAppearancesLib.model.fold import Fold
from ExpectedAppearancesLib.model.losses import segmentation_loss
from ExpectedAppearancesLib.model.networks import SegmentedRegressor, build_network
from ExpectedAppearancesLib.model.presets import PRESETS
from ExpectedAppearancesLib.model.training import train_case
from ExpectedAppearancesLib.registration.poses_file import write_poses
from ExpectedAppearancesLib.registration.predictor import Predictor


@pytest.fixture
def poses_file(case, tmp_path):  # noqa: F811
    """Two of the four poses that the case's appearances of method image are seen from."""
    frames = [
        {"image": f"{i}.png", "camera_from_world": f["camera_from_world"]} for i, f in enumerate(read_rendered(case))
    ]
    write_poses(tmp_path / "known.json", camera(), frames[:2])
    return tmp_path / "known.json"


@pytest.mark.parametrize("method", ["surface", "image"])
def test_views_of_the_papers_form_repeat_the_known_poses(case, poses_file, method):  # noqa: F811
    source = views.ViewSource(case.folder, settings(method, poses_file=str(poses_file)))
    known = [frame["camera_from_world"] for frame in read_rendered(case)[:2]]
    nearest = [[np.abs(source.view(i).camera_from_world - pose).max() for pose in known] for i in range(12)]
    assert np.min(nearest, axis=1).max() < 1e-9 and set(np.argmin(nearest, axis=1)) == {0, 1}


def test_a_fold_trains_without_what_it_leaves_out_and_leaves_the_case_alone(case, poses_file, tmp_path):  # noqa: F811
    before = (case.folder / "case.json").read_bytes()
    fold = Fold(tmp_path / "fold", ("a",), poses_file)
    train_case(case, TINY, lambda *_: None, CPU, method="surface", fold=fold)
    meta = json.loads((fold.folder / "model.json").read_text())
    assert meta["styles"] == ["b"] and Predictor(fold.folder).estimator == "dense"
    assert (case.folder / "case.json").read_bytes() == before and not case.model_folder.exists()


def test_every_reason_why_a_fold_cannot_be_trained_is_said(case, tmp_path, capsys):  # noqa: F811
    fold = ["--model-folder", str(tmp_path / "fold")]
    code = main(["train", str(case.folder), *fold, "--exclude", "a", "b", "z", "--poses", str(tmp_path / "none.json")])
    text = capsys.readouterr().err
    assert code == 2 and all(word in text for word in ("'z'", "nothing is left", "none.json"))
    assert main(["train", str(case.folder), "--exclude", "a"]) == 2
    assert "--model-folder: missing" in capsys.readouterr().err
    far = np.eye(4)
    far[2, 3] = 500
    write_poses(tmp_path / "far.json", camera(), [{"image": "0.png", "camera_from_world": far}])
    with pytest.raises(InputError, match="synthesised at any of its poses"):
        train_case(case, TINY, lambda *_: None, CPU, method="image", fold=Fold(tmp_path, (), tmp_path / "far.json"))


def test_a_texture_that_is_seen_from_none_of_the_poses_is_not_used(case, poses_file):  # noqa: F811
    """Where each pose is made in one texture: kept for choosing the epoch, it ended the training in numpy's error."""
    _, made = read_appearances(case, "image")
    own = [replace(a, style=style) for a, style in zip(made[::2], "abcd")]  # made: each pose in two textures
    assert Fold(case.folder, (), poses_file).styles("image", own) == ["a", "b"]
    assert Fold(case.folder, (), poses_file).styles("surface", own) == ["a", "b", "c", "d"]


def test_both_parts_of_a_rival_learn_apart():
    torch.manual_seed(0)
    network = build_network("regression", 64, 0.4, "probability")
    image, rendered = torch.rand(2, 3, 64, 64), (torch.rand(2, 1, 32, 32) > 0.7).float()
    logits, pose = network(image, rendered)
    assert logits.shape == rendered.shape and pose.shape == (2, 6)
    segmentation_loss(logits, rendered).backward(retain_graph=True)
    assert all(p.grad is None for p in network.regressor.parameters())
    assert any(p.grad.abs().sum() > 0 for p in network.segmenter.parameters())
    network.zero_grad(set_to_none=True)
    pose.square().sum().backward()
    assert all(p.grad is None for p in network.segmenter.parameters())


def test_a_rivals_pose_is_learnt_in_full_precision_where_the_rest_is_not():
    torch.manual_seed(0)
    network = build_network("regression", 64, 0.4, "probability")
    image, rendered = torch.rand(2, 3, 64, 64), (torch.rand(2, 1, 32, 32) > 0.7).float()
    with torch.autocast("cpu", torch.bfloat16):
        logits, pose = network(image, rendered)
    torch.testing.assert_close(pose, network.regressor(rendered), rtol=0, atol=0)
    assert not torch.equal(logits, network.segmenter(image))


def test_what_the_pose_network_reads():
    torch.manual_seed(0)
    image, seen = torch.rand(1, 3, 64, 64), []
    for reads in ("probability", "mask"):
        network = SegmentedRegressor(64, 0.4, reads).eval()
        network.segmenter.head.weight.data *= 100  # as sure of itself as a trained one
        network.regressor.register_forward_pre_hook(lambda _module, inputs: seen.append(inputs[0].detach()))
        with torch.no_grad():
            network(image)
            logits = network.segmenter(image)
        if reads == "probability":
            torch.testing.assert_close(seen[-1], torch.sigmoid(logits))
        else:
            sure = logits.abs() > 0.01
            assert sure.float().mean() > 0.9
            torch.testing.assert_close(seen[-1][sure], (logits > 0).float()[sure])


def test_segmentation_loss_is_least_where_it_is_right():
    truth = torch.zeros(1, 1, 16, 16)
    truth[..., 4:8] = 1
    right = 20 * truth - 10
    assert segmentation_loss(right, truth) < 0.01
    assert segmentation_loss(-right, truth) > segmentation_loss(torch.zeros_like(truth), truth) > 0.5


@pytest.mark.parametrize("name", ["probseg", "binseg"])
def test_a_rival_is_trained_exported_and_read_like_every_model(case, tmp_path, name):  # noqa: F811
    preset = replace(
        PRESETS[name], size_px=64, steps=4, batch=4, fresh=2, validation_views=6, validate_every=2, width=0.4
    )
    figures = train_case(case, preset, lambda *_: None, CPU, method="surface", fold=Fold(tmp_path))
    meta = json.loads((tmp_path / "model.json").read_text())
    assert figures["steps"] == 4 and meta["export_difference"] < 1e-4 and meta["preset"] == name
    predictor = Predictor(tmp_path)
    assert predictor.estimator == "regression"
    prediction = predictor.predict(np.random.default_rng(0).integers(0, 255, (96, 96, 3)).astype(np.uint8), camera())
    assert prediction.camera_from_world.shape == (4, 4) and 0 <= prediction.confidence <= 1


def test_rivals_have_the_papers_network_and_schedule():
    paper = PRESETS["paper"]
    for name in ("probseg", "binseg"):
        rival = PRESETS[name]
        assert (rival.batch, rival.learning_rate, rival.steps) == (paper.batch, paper.learning_rate, paper.steps)
        assert rival.size_px // 2 == paper.size_px  # the masks that the pose network reads
