import itertools

import numpy as np
import pytest
import torch
from cases import label_map, texture

from ExpectedAppearancesLib.appearances.gram import ClassGramLoss, class_masks, texture_grams
from ExpectedAppearancesLib.appearances.images import to_rgb, to_vgg_input
from ExpectedAppearancesLib.appearances.lbfgs import minimise
from ExpectedAppearancesLib.appearances.measure import GramMeasure
from ExpectedAppearancesLib.appearances.synthesis import Job, Synthesizer, _start
from ExpectedAppearancesLib.appearances.vgg import load_vgg
from ExpectedAppearancesLib.appearances.workload import (
    BYTES_PER_PIXEL,
    bytes_per_image,
    images_at_once,
    operations_per_evaluation,
)
from ExpectedAppearancesLib.devices import fast_dtype
from ExpectedAppearancesLib.errors import InputError

CLASSES = (1, 2)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def vgg():
    return load_vgg()


def tensors(seed: int):
    torch.manual_seed(seed)
    labels = torch.from_numpy(label_map())[None]
    return 40 * torch.randn(1, 3, 48, 48), labels


def plain_features(vgg, x):
    found = []
    for name in vgg.names:
        if name.endswith("_1") and name != "conv1_1":
            x = torch.nn.functional.avg_pool2d(x, 2)
        weight, bias = getattr(vgg, f"{name}_weight"), getattr(vgg, f"{name}_bias")
        x = torch.nn.functional.conv2d(x, weight, bias, padding=1).relu()
        if name.endswith("_1"):
            found.append(x)
    return found


def plain_gram(features, mask):
    masked = (features * mask).flatten(2)[0]
    return masked @ masked.T / (masked.numel() * mask.mean())


def plain_loss(vgg, image, labels, targets):
    """Reference: autograd through masked features, whole masks, no pixel lists."""
    masks = vgg.carry_masks(class_masks(labels, CLASSES))
    total = 0
    for features, mask, target in zip(plain_features(vgg, image), masks, targets, strict=True):
        for c in range(len(CLASSES)):
            difference = plain_gram(features, mask[:, c]) - target[c]
            total = total + difference.square().sum() / target[c].square().sum()
    return total


def test_loss_and_gradient_equal_the_plain_implementation(vgg):
    image, labels = tensors(0)
    targets = texture_grams(vgg, 40 * torch.randn(3, 48, 48), labels[0].flip(1), CLASSES)
    loss = ClassGramLoss(vgg, labels, [t[None] for t in targets], CLASSES)
    ours, gradient = loss.value_and_gradient(image)
    torch.testing.assert_close(loss(image), ours)
    image.requires_grad_(True)
    plain = plain_loss(vgg, image, labels, targets)
    assert ours.item() == pytest.approx(plain.item(), rel=1e-4)
    (expected,) = torch.autograd.grad(plain, image)
    assert (gradient - expected).norm() / expected.norm() < 1e-4


def test_gradients_do_not_leak_between_classes(vgg):
    """At each layer the gradient of one class's loss is zero wherever its own carried mask is zero."""
    image, labels = tensors(1)
    masks = vgg.carry_masks(class_masks(labels, CLASSES))
    targets = texture_grams(vgg, 40 * torch.randn(3, 48, 48), labels[0], CLASSES)
    without_vessels = [t.clone() for t in targets]
    for t in without_vessels:
        t[1] = float("nan")  # as of a texture that shows no vessels
    loss = ClassGramLoss(vgg, labels, [t[None] for t in without_vessels], CLASSES)
    for layer, (features, mask) in enumerate(zip(vgg(image), masks, strict=True)):
        gradient = torch.zeros_like(features)
        loss._add_layer(torch.zeros(1), 0, layer, features, gradient)
        outside = (mask[0, 0] == 0).expand_as(gradient[0])
        assert gradient[0][outside].abs().sum() == 0
        assert gradient.abs().sum() > 0


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_loss_and_gradient_do_not_depend_on_the_batch_nor_in_bf16_on_the_threads(dtype):
    if dtype == torch.bfloat16 and fast_dtype(CPU) != dtype:
        pytest.skip("this processor does not multiply bf16")
    vgg = load_vgg(None, dtype)
    torch.manual_seed(3)
    images = 40 * torch.randn(3, 3, 64, 64)
    labels = torch.from_numpy(np.stack([label_map(64), label_map(64).T, label_map(64)[::-1]]).copy())
    targets = texture_grams(vgg, 40 * torch.randn(3, 64, 64), labels[0], CLASSES)
    stacked = [t.expand(3, *t.shape) for t in targets]
    together = ClassGramLoss(vgg, labels, stacked, CLASSES).value_and_gradient(images)
    threads = torch.get_num_threads()
    try:
        if dtype == torch.bfloat16:
            torch.set_num_threads(1 if threads > 1 else 2)
        one_by_one = ClassGramLoss(vgg, labels, stacked, CLASSES, 64 * 64).value_and_gradient(images)
        alone = ClassGramLoss(vgg, labels[1:2], [t[None] for t in targets], CLASSES).value_and_gradient(images[1:2])
    finally:
        torch.set_num_threads(threads)
    for a, b, c in zip(together, one_by_one, alone, strict=True):
        assert torch.equal(a, b) and torch.equal(a[1:2], c)


def test_masks_are_halved_and_softened_as_features_are(vgg):
    masks = vgg.carry_masks(class_masks(torch.from_numpy(label_map())[None], CLASSES))
    assert [m.shape[-1] for m in masks] == [48, 24, 12, 6, 3]
    # One 3x3 mean at the first layer: the corner of the parenchyma counts the pixels around it.
    assert masks[0][0, 0, 4, 2] == pytest.approx(4 / 9)
    assert masks[0][0, 0, 4, 3] == pytest.approx(6 / 9)


def with_gradient(loss):
    def value_and_gradient(x):
        x = x.clone().requires_grad_(True)
        values = loss(x)
        return values.detach(), torch.autograd.grad(values.sum(), x)[0]

    return value_and_gradient


def test_a_batch_gives_each_problem_what_it_gets_alone():
    torch.manual_seed(2)
    scales = torch.tensor([[1.0, 30.0, 400.0], [5.0, 0.3, 2.0]])
    middle = torch.tensor([[1.0, -2.0, 3.0], [-30.0, 10.0, 0.5]])

    def loss(x, rows=slice(None)):
        d = x - middle[rows]
        return (scales[rows] * d**2).sum(dim=1) + 0.1 * (d**4).sum(dim=1)

    together, _ = minimise(with_gradient(loss), torch.zeros(2, 3), 40)
    for row in (0, 1):
        alone, value = minimise(with_gradient(lambda x, r=row: loss(x, slice(r, r + 1))), torch.zeros(1, 3), 40)
        assert torch.equal(together[row], alone[0])
        assert value.item() < 1e-6
    torch.testing.assert_close(together, middle, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("history", [3, 100])
def test_directions_are_those_of_the_two_loop_recursion(history):
    """Reference: Nocedal & Wright, algorithm 7.4, written out in float64."""
    rng = np.random.default_rng(0)
    matrix = rng.normal(size=(30, 30))
    matrix = matrix @ matrix.T / 30 + np.eye(30)
    offset = rng.normal(size=30)
    x, step, pairs, previous = np.zeros(30), None, [], None
    visited = []
    for _ in range(12):
        visited.append(x)
        gradient = matrix @ x - offset
        if previous is not None:
            pairs = [*pairs, (step, gradient - previous)][-history:]
        q, alphas = gradient.copy(), []
        for s, y in reversed(pairs):
            alphas.append(s @ q / (s @ y))
            q -= alphas[-1] * y
        q *= pairs[-1][0] @ pairs[-1][1] / (pairs[-1][1] @ pairs[-1][1]) if pairs else 0.1 / np.sqrt((q**2).mean())
        for (s, y), alpha in zip(pairs, reversed(alphas), strict=True):
            q += (alpha - y @ q / (s @ y)) * s
        step, previous = -q, gradient
        x = x + step
    ours = []

    def value_and_gradient(points):
        ours.append(points[0].double().numpy())
        gradient = points.double() @ torch.from_numpy(matrix) - torch.from_numpy(offset)
        return torch.zeros(1), gradient.float()

    minimise(value_and_gradient, torch.zeros(1, 30), 11, history, first_step=0.1, patience=100)
    np.testing.assert_allclose(ours, visited, atol=2e-4)


def test_each_problem_stops_where_it_gains_nothing_more():
    seen = []

    def loss(x):
        seen.append(x.detach().clone())
        falls = (x[:1] - 40).abs().sum(dim=1)  # by a full step each time, for long
        rests = (x[1:] - 1).square().sum(dim=1) + 1
        return torch.cat([falls, rests])

    _, values = minimise(with_gradient(loss), torch.zeros(2, 3), 40, largest_step=0.5, patience=4)
    points = torch.stack(seen)
    assert values[1] == pytest.approx(1.0, abs=1e-3)
    moved = (points[1:, 1] - points[:-1, 1]).abs().sum(dim=1)
    assert (moved[-20:] == 0).all() and (moved[:2] > 0).all()
    assert (points[1:, 0] != points[:-1, 0]).any(dim=1).all()
    alone = []
    minimise(with_gradient(lambda x: alone.append(1) or x.square().sum(dim=1) + 1), torch.ones(1, 3), 40, patience=4)
    assert len(alone) < 20


def test_one_hopeless_problem_does_not_spoil_its_neighbour():
    def loss(x):
        values = (x**2).sum(dim=1)
        return torch.stack([values[0], values[1] * float("nan")])

    best, values = minimise(with_gradient(loss), torch.full((2, 3), 4.0), 20)
    assert values[0] < 1e-8 and best[0].abs().max() < 1e-3


def test_each_class_takes_the_textures_colour_and_background_stays_black(vgg):
    job = Job(label_map(), texture(), seed=1)
    (image,) = Synthesizer(vgg, CPU, 15).run([job])
    before, after = (
        sum(GramMeasure(vgg).distances(i, job.labels, job.texture).values())
        for i in (to_rgb(_start(job)) * (job.labels > 0)[..., None], image)
    )
    assert after < 0.3 * before
    assert not image[job.labels == 0].any()
    means = {c: job.texture.image[job.texture.labels == c].astype(float).mean(axis=0) for c in CLASSES}
    for own, other in (CLASSES, CLASSES[::-1]):
        inner = image[job.labels == own].astype(float).mean(axis=0)
        assert np.linalg.norm(inner - means[own]) < 0.4 * np.linalg.norm(inner - means[other])


def test_same_seed_same_image_whatever_its_neighbours(vgg):
    jobs = [Job(label_map(), texture("a"), 3), Job(label_map().T.copy(), texture("b", (200, 180, 40)), 4)]
    first, second = Synthesizer(vgg, CPU, 6).run(jobs)
    (alone,) = Synthesizer(vgg, CPU, 6).run(jobs[1:])
    np.testing.assert_array_equal(second, alone)
    (again,) = Synthesizer(vgg, CPU, 6).run(jobs[:1])
    np.testing.assert_array_equal(first, again)


def test_weights_that_cannot_be_used_are_refused(tmp_path):
    with pytest.raises(InputError, match="not found"):
        load_vgg(tmp_path / "none.pth")
    (tmp_path / "cut.safetensors").write_bytes(b"\x08\0\0\0\0\0\0\0{}")
    with pytest.raises(InputError, match=r"cut\.safetensors"):
        load_vgg(tmp_path / "cut.safetensors")
    torch.save({"features.0.weight": torch.zeros(64, 3, 3, 3), "features.0.bias": torch.zeros(64)}, tmp_path / "x.pth")
    with pytest.raises(InputError, match="missing"):
        load_vgg(tmp_path / "x.pth")


def test_torchvision_weights_give_the_same_features(tmp_path, vgg):
    """A torchvision file expects RGB 0..1 standardised by channel; loaded, it must read BGR 0..255 minus the mean."""
    torch.manual_seed(0)
    indices = [0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28]
    widths = [3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512]
    state = {}
    for i, (a, b) in zip(indices, itertools.pairwise(widths), strict=True):
        state[f"features.{i}.weight"] = torch.randn(b, a, 3, 3) * 0.05
        state[f"features.{i}.bias"] = torch.randn(b) * 0.1
    torch.save(state, tmp_path / "vgg16.pth")
    loaded = load_vgg(tmp_path / "vgg16.pth")
    rgb = torch.rand(1, 3, 16, 16)
    mean, scale = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    expected = torch.relu(
        torch.nn.functional.conv2d(
            (rgb - mean[:, None, None]) / scale[:, None, None],
            state["features.0.weight"],
            state["features.0.bias"],
            padding=1,
        )
    )
    bgr = rgb.flip(1) * 255 - torch.tensor([103.939, 116.779, 123.68])[:, None, None]
    inner = (slice(None), slice(None), slice(1, -1), slice(1, -1))
    torch.testing.assert_close(loaded(bgr)[0][inner], expected[inner], rtol=2e-3, atol=5e-3)


def test_the_measure_is_the_plain_loss_in_fp32_of_the_saved_image(vgg):
    rng = np.random.default_rng(0)
    image, labels, t = rng.integers(0, 256, (48, 48, 3), np.uint8), label_map(), texture()
    targets = texture_grams(vgg, to_vgg_input(t.image), torch.from_numpy(t.labels), CLASSES)
    expected = plain_loss(vgg, to_vgg_input(image)[None], torch.from_numpy(labels)[None], targets)
    found = GramMeasure(vgg).distances(image, labels, t)
    assert set(found) == {"parenchyma", "vessels"}
    assert sum(found.values()) == pytest.approx(float(expected), rel=1e-4)
    # The texture itself, on its own labels, is at no distance; a class that the labels lack is not counted.
    assert sum(GramMeasure(vgg).distances(t.image, t.labels, t).values()) < 1e-6
    assert set(GramMeasure(vgg).distances(image, np.minimum(labels, 1), t)) == {"parenchyma"}


def test_targets_are_made_once_for_a_texture_and_only_few_are_kept(vgg, monkeypatch):
    calls = []
    original = texture_grams
    monkeypatch.setattr(
        "ExpectedAppearancesLib.appearances.gram.texture_grams", lambda *a: calls.append(1) or original(*a)
    )
    synthesizer = Synthesizer(vgg, CPU, 1)
    for seed in range(3):
        synthesizer.run([Job(label_map(), texture("a"), seed)])
    assert len(calls) == 1
    for i in range(20):
        synthesizer.targets.of(texture(f"t{i}", (10 * i, 0, 0)), 32, 32)
    assert len(synthesizer.targets._kept) <= 4


def test_a_texture_is_known_by_its_content_not_by_its_name(vgg):
    """A worker of a cluster goes on living when a texture has been corrected, or serves a patient with others."""
    first, corrected = texture("a"), texture("a", (30, 200, 40))
    measure = GramMeasure(vgg)
    measure.distances(first.image, first.labels, first)
    distances = measure.distances(corrected.image, corrected.labels, corrected)
    assert max(distances.values()) < 1e-6, "compared with the texture that was called so before"


def test_memory_does_not_grow_with_the_sizes_of_textures(vgg):
    """Photographs are cropped by hand: each has a size of its own."""
    measure = GramMeasure(vgg)
    kept = []
    for width in (48, 40, 33):
        t = texture("a", size=48)
        labels = np.ascontiguousarray(t.labels[:, :width])
        measure.distances(np.ascontiguousarray(t.image[:, :width]), labels, t)
        kept.append(len(vgg._packed))
    assert kept[0] == kept[-1]


def test_operations_are_those_of_the_layers():
    """By hand for VGG-16 at 32 px, one class on a quarter of the pixels."""
    convolutions = (
        32**2 * (3 * 64 + 64 * 64) + 16**2 * (64 * 128 + 128 * 128) + 8**2 * (128 * 256 + 2 * 256 * 256)
        + 4**2 * (256 * 512 + 2 * 512 * 512) + 2**2 * 512 * 512
    )  # fmt: skip
    grams = 0.25 * (32**2 * 64**2 + 16**2 * 128**2 + 8**2 * 256**2 + 4**2 * 512**2 + 2**2 * 512**2)
    expected = 2 * 2 * 9 * convolutions + 2 * 2 * grams
    assert operations_per_evaluation((32, 32), "vgg16", (0.25,)) == pytest.approx(expected)


def test_batch_follows_the_memory_that_is_free(monkeypatch):
    import psutil

    def with_free(amount):
        monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": amount}))
        return images_at_once((96, 96), 40, CPU)

    each = bytes_per_image((96, 96), 40)
    assert each > 96 * 96 * 3 * 4 * 2 * 40  # below 128 px the history is that of all iterations
    assert with_free(1 << 40) == 14  # 2^17 px go through the network at once
    network = BYTES_PER_PIXEL * 2**17
    assert with_free(network + 2 * 5 * each + each) == 5
    assert with_free(1 << 20) == 1
