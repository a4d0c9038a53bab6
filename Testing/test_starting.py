"""Training of the dense network starts at weights learnt on a generated patient."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from ExpectedAppearancesLib.errors import InputError
from ExpectedAppearancesLib.model import checkpoint, starting
from ExpectedAppearancesLib.model.networks import build_network
from ExpectedAppearancesLib.model.presets import PRESETS

QUICK = PRESETS["quick"]


def quick_network() -> torch.nn.Module:
    torch.manual_seed(3)
    return build_network(QUICK.estimator, QUICK.size_px, QUICK.width)


def test_everything_but_the_head_starts_at_the_shipped_weights():
    network, before = quick_network(), quick_network().state_dict()
    assert starting.load_start(network)
    shipped = load_file(str(starting.SHIPPED))
    for name, tensor in network.state_dict().items():
        assert tensor.dtype == before[name].dtype
        expected = before[name] if name.startswith("head.") else shipped[name].to(tensor.dtype)
        assert torch.equal(tensor, expected), name
    assert not torch.equal(network.state_dict()["stem.1.0.weight"], before["stem.1.0.weight"])


def test_shipped_weights_tell_vessels_of_a_patient_they_never_saw():
    """What comes before the head tells vessel from parenchyma by a linear reading, better than chance weights do."""
    from ExpectedAppearancesLib.demo.vessel_tree import demo_camera, generate_case_meshes
    from ExpectedAppearancesLib.masks.labels import VESSELS
    from ExpectedAppearancesLib.masks.renderer import MaskRenderer
    from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy
    from ExpectedAppearancesLib.poses.sampling import PoseRanges, PoseSampler

    vessels, cortex = generate_case_meshes(7)
    camera = demo_camera().resized(128, 128)
    sampler = PoseSampler(find_craniotomy(vessels, cortex), PoseRanges(), camera, vessels.vertices_mm, seed=2)
    with MaskRenderer(vessels, cortex, camera) as renderer:
        labels = np.stack([renderer.render(sampler.sample(i)) for i in range(4)])
    rng = np.random.default_rng(0)
    colours = np.array([(0, 0, 0), (195, 140, 125), (165, 105, 105)], np.float32)
    images = np.clip(colours[labels] + rng.normal(0, 20, (*labels.shape, 1)) * (labels[..., None] > 0), 0, 255)
    inputs = torch.from_numpy((images / 255).astype(np.float32)).permute(0, 3, 1, 2)
    tissue = labels[:, ::2, ::2] > 0
    is_vessel = (labels[:, ::2, ::2] == VESSELS)[tissue]

    def separation(network) -> float:
        network.eval()
        network.head = torch.nn.Identity()
        with torch.no_grad():
            features = network(inputs).permute(0, 2, 3, 1).numpy()[tissue].astype(float)
        inside, outside = features[is_vessel], features[~is_vessel]
        spread = np.cov(inside.T) + np.cov(outside.T) + 1e-6 * np.eye(features.shape[1])
        apart = inside.mean(axis=0) - outside.mean(axis=0)
        return float(np.sqrt(apart @ np.linalg.solve(spread, apart)))

    chance, started = quick_network(), quick_network()
    starting.load_start(started)
    assert separation(started) > 1.3 * separation(chance)


def test_another_network_is_left_as_it_is():
    network = build_network("dense", 128, 0.5)
    before = {name: tensor.clone() for name, tensor in network.state_dict().items()}
    assert not starting.load_start(network)
    assert all(torch.equal(tensor, before[name]) for name, tensor in network.state_dict().items())


def test_a_damaged_or_missing_file_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(starting, "SHIPPED", tmp_path / "weights.safetensors")
    with pytest.raises(InputError, match="install the package again"):
        starting.load_start(quick_network())
    starting.SHIPPED.write_bytes(b"cut")
    with pytest.raises(InputError, match="install the package again"):
        starting.load_start(quick_network())


def test_the_best_weights_of_a_training_are_written(tmp_path, monkeypatch):
    network = quick_network()
    best = {name: tensor + 1 for name, tensor in network.state_dict().items()}
    optimizer = torch.optim.AdamW(network.parameters())
    checkpoint.save(tmp_path, network, network.state_dict(), best, optimizer, {"settings": {}})
    monkeypatch.setattr(starting, "SHIPPED", tmp_path / "weights.safetensors")
    starting.write_start(tmp_path, starting.SHIPPED)
    other = build_network(QUICK.estimator, QUICK.size_px, QUICK.width)
    assert starting.load_start(other)
    torch.testing.assert_close(other.state_dict()["up1.0.weight"], best["up1.0.weight"], atol=2e-3, rtol=0)
    with pytest.raises(InputError, match="model folder"):
        starting.write_start(tmp_path / "nowhere")
