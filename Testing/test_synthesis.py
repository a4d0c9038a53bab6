import itertools
import subprocess
import sys
import time

import numpy as np
import pytest
import torch
from cases import write_inputs

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import store
from ExpectedAppearancesLib.appearances.gram import ClassGramLoss, class_gram, class_masks, texture_grams
from ExpectedAppearancesLib.appearances.lbfgs import minimise
from ExpectedAppearancesLib.appearances.stage import synthesize_case
from ExpectedAppearancesLib.appearances.synthesis import Job, Synthesizer
from ExpectedAppearancesLib.appearances.vgg import load_vgg
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.cli import main
from ExpectedAppearancesLib.devices import fast_dtype
from ExpectedAppearancesLib.errors import CancelledError, InputError
from ExpectedAppearancesLib.masks.stage import render_case
from ExpectedAppearancesLib.poses.craniotomy import find_craniotomy
from ExpectedAppearancesLib.textures.library import Texture

CLASSES = (1, 2)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def vgg():
    return load_vgg()


def label_map(size: int = 48) -> np.ndarray:
    labels = np.zeros((size, size), np.uint8)
    labels[4:-4, 2:-6] = 1
    labels[size // 3 : size // 2, : size // 2] = 2
    return labels


def texture(name: str = "a", vessel_colour=(40, 30, 160), size: int = 48) -> Texture:
    rng = np.random.default_rng(5)
    labels = np.ones((size, size), np.uint8)
    labels[size // 2 :, size // 3 : size // 2] = 2
    image = np.where((labels == 2)[..., None], vessel_colour, (210, 130, 110)) + rng.normal(0, 15, (size, size, 3))
    return Texture(name, np.clip(image, 0, 255).astype(np.uint8), labels)


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


def plain_loss(vgg, image, labels, targets):
    """Reference: autograd through masked features, whole masks, no pixel lists."""
    masks = vgg.carry_masks(class_masks(labels, CLASSES))
    total = 0
    for features, mask, target in zip(plain_features(vgg, image), masks, targets, strict=True):
        for c in range(len(CLASSES)):
            difference = class_gram(features, mask[:, c]) - target[None, c]
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
    x, pairs, previous = np.zeros(30), [], None
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

    minimise(value_and_gradient, torch.zeros(1, 30), 11, history, first_step=0.1)
    np.testing.assert_allclose(ours, visited, atol=2e-4)


def test_one_hopeless_problem_does_not_spoil_its_neighbour():
    def loss(x):
        values = (x**2).sum(dim=1)
        return torch.stack([values[0], values[1] * float("nan")])

    best, values = minimise(with_gradient(loss), torch.full((2, 3), 4.0), 20)
    assert values[0] < 1e-8 and best[0].abs().max() < 1e-3


def test_each_class_takes_the_textures_colour_and_background_stays_black(vgg):
    job = Job(label_map(), texture(), seed=1)
    ((image, distance),) = Synthesizer(vgg, CPU, 15).run([job])
    ((_, first),) = Synthesizer(vgg, CPU, 0).run([job])
    assert distance < 0.3 * first
    assert not image[job.labels == 0].any()
    means = {c: job.texture.image[job.texture.labels == c].astype(float).mean(axis=0) for c in CLASSES}
    for own, other in (CLASSES, CLASSES[::-1]):
        inner = image[job.labels == own].astype(float).mean(axis=0)
        assert np.linalg.norm(inner - means[own]) < 0.4 * np.linalg.norm(inner - means[other])


def test_same_seed_same_image_whatever_its_neighbours(vgg):
    jobs = [Job(label_map(), texture("a"), 3), Job(label_map().T.copy(), texture("b", (200, 180, 40)), 4)]
    (first, _), (second, _) = Synthesizer(vgg, CPU, 6).run(jobs)
    ((alone, _),) = Synthesizer(vgg, CPU, 6).run(jobs[1:])
    np.testing.assert_array_equal(second, alone)
    ((again, _),) = Synthesizer(vgg, CPU, 6).run(jobs[:1])
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


@pytest.fixture
def case(tmp_path):
    paths = write_inputs(tmp_path)
    case = Case.create(tmp_path / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    render_case(case, lambda *_: None, poses=3)
    return case


@pytest.mark.parametrize("method", ["surface", "image"])
def test_a_killed_synthesis_goes_on_and_ends_as_if_it_had_not_been(case, method):
    textures = [texture("a"), texture("b", (200, 180, 40))]

    def cancel_in_second(fraction, _message):
        if fraction > 0.6:
            raise CancelledError("stop")

    with pytest.raises(CancelledError):
        synthesize_case(case, textures, cancel_in_second, method, size_px=48, iterations=4)
    with pytest.raises(InputError, match="not finished"):
        store.read_appearances(case, method)
    folder = store.folder_of(case, method)
    kept = {p.name: p.stat().st_mtime_ns for p in folder.glob("*.png") if "labels" not in p.name}
    assert kept
    synthesize_case(case, textures, lambda *_: None, method, size_px=48, iterations=4)
    _, resumed = store.read_appearances(case, method)
    assert len(resumed) == (2 if method == "surface" else 3)
    for name, stamp in kept.items():
        assert (folder / name).stat().st_mtime_ns == stamp
    images = {a.image_path.name: files.read_image_rgb(a.image_path) for a in resumed}
    (folder / "index.json").unlink()
    synthesize_case(case, textures, lambda *_: None, method, size_px=48, iterations=4)
    for appearance in store.read_appearances(case, method)[1]:
        np.testing.assert_array_equal(files.read_image_rgb(appearance.image_path), images[appearance.image_path.name])


def test_a_changed_texture_or_axis_is_not_passed_over(case):
    def made(textures):
        synthesize_case(case, textures, lambda *_: None, "surface", size_px=32, iterations=1)
        return {a.style: a.image_path.stat().st_mtime_ns for a in store.read_appearances(case, "surface")[1]}

    first = made([texture("a"), texture("b")])
    assert made([texture("a"), texture("b")]) == first
    second = made([texture("a"), texture("b", (10, 200, 10))])
    assert second["a"] == first["a"] and second["b"] != first["b"]
    render_case(case, lambda *_: None, 3, craniotomy=find_craniotomy(case.vessels, normal=[0.3, 0, 1]))
    third = made([texture("a"), texture("b", (10, 200, 10))])
    assert third["a"] != second["a"] and third["b"] != second["b"]


def test_paper_preset_makes_every_pose_with_every_texture(case):
    textures = [texture("a"), texture("b")]
    synthesize_case(case, textures, lambda *_: None, "image", size_px=32, iterations=1, every_texture=True)
    _, appearances = store.read_appearances(case, "image")
    assert len(appearances) == 6 and {a.style for a in appearances} == {"a", "b"}


def test_a_synthesis_killed_by_the_system_loses_no_finished_image(case, tmp_path):
    for name in "abcdef":
        files.write_png(tmp_path / "textures" / f"{name}.png", texture(name, size=96).image)
    files.write_png(tmp_path / "textures" / "labels.png", texture(size=96).labels)
    arguments = [str(case.folder), "--textures", str(tmp_path / "textures"), "--size", "48", "--iterations", "25"]
    process = subprocess.Popen([sys.executable, "-m", "ExpectedAppearancesLib", "synthesize", *arguments])
    folder = store.folder_of(case, "surface")
    deadline = time.monotonic() + 120
    while not (folder / "b-0.png").is_file() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.02)
    process.kill()
    process.wait()
    kept = {item["image"] for item in store.read_index(case, "surface")["items"]}
    assert kept and not store.read_index(case, "surface")["done"]
    stamps = {name: (folder / name).stat().st_mtime_ns for name in kept}
    assert main(["synthesize", *arguments]) == 0
    assert len(store.read_appearances(case, "surface")[1]) == 6
    assert {name: (folder / name).stat().st_mtime_ns for name in kept} == stamps
