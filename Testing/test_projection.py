"""Appearances laid on the surface, and what surrounds it in a view."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from cases import write_inputs

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.appearances import projection
from ExpectedAppearancesLib.appearances.overview import overview_view
from ExpectedAppearancesLib.appearances.projection import SurfacePainter, parenchyma_plate
from ExpectedAppearancesLib.appearances.store import Appearance
from ExpectedAppearancesLib.augmentation.impostors import impostor
from ExpectedAppearancesLib.augmentation.surroundings import continue_tissue, fill_outside, opening
from ExpectedAppearancesLib.case.case import Case
from ExpectedAppearancesLib.masks.labels import PARENCHYMA, VESSELS
from ExpectedAppearancesLib.masks.renderer import MaskRenderer
from ExpectedAppearancesLib.masks.stage import craniotomy_of, sampler_of

RED, BLUE = (220, 60, 60), (40, 40, 200)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Case, overview appearance in two plain colours, and one pose with what the camera sees there."""
    folder = tmp_path_factory.mktemp("projection")
    paths = write_inputs(folder)
    case = Case.create(folder / "case", paths["vessels.vtp"], paths["cortex.vtp"], paths["camera.json"])
    camera, pose = overview_view(craniotomy_of(case), case.cortex, 128)
    with MaskRenderer(case.vessels, case.cortex, camera) as renderer:
        labels = renderer.render(pose)
    image = np.zeros((128, 128, 3), np.uint8)
    image[labels == PARENCHYMA], image[labels == VESSELS] = RED, BLUE
    files.write_png(folder / "a.png", image)
    files.write_png(folder / "labels.png", labels)
    appearance = Appearance(folder / "a.png", folder / "labels.png", "a", 0, camera, pose, 0.0)
    view = sampler_of(case, 1).sample(0)
    with MaskRenderer(case.vessels, case.cortex, case.camera) as renderer:
        seen = renderer.render_surface(view)
    return case, appearance, view, seen


def test_places_in_the_overview_are_projections_of_the_points(scene):
    case, appearance, _, (labels, _, points) = scene
    painter = SurfacePainter(case.vessels, case.cortex, [appearance])
    flat = points.reshape(-1, 3)[labels.ravel() > 0].astype(float)
    vector = cv2.Rodrigues(appearance.camera_from_world[:3, :3])[0]
    expected = cv2.projectPoints(flat, vector, appearance.camera_from_world[:3, 3], appearance.camera.matrix, None)[0]
    found = painter.overview_px(points).reshape(-1, 2)[labels.ravel() > 0]
    assert np.abs(found - expected[:, 0]).max() < 0.02


@pytest.mark.parametrize("registered", [0.0, 1.0])
def test_classes_keep_their_place_and_colour_wherever_the_parenchyma_comes_from(scene, monkeypatch, registered):
    case, appearance, view, (labels, depth_mm, points) = scene
    monkeypatch.setattr(projection, "REGISTERED", registered)
    monkeypatch.setattr(projection, "FAINT", 0.0)
    monkeypatch.setattr(projection, "DEPTH_OF_FIELD", 0.0)
    monkeypatch.setattr(SurfacePainter, "_lit", lambda _self, image, *_: image)
    painter = SurfacePainter(case.vessels, case.cortex, [appearance])
    image = painter.paint(labels, depth_mm, painter.overview_px(points), view, np.random.default_rng(0)).astype(int)
    inside = cv2.erode((labels == PARENCHYMA).astype(np.uint8), np.ones((7, 7))) > 0
    assert np.abs(image[inside] - RED).mean() < 12
    blue = image[..., 2] > image[..., 0]
    assert (blue & (labels == VESSELS)).sum() > 0.8 * (labels == VESSELS).sum()
    assert not (blue & inside).any()


def test_faint_vessels_shine_through_the_parenchyma_alike_all_over_and_are_never_gone(scene, monkeypatch):
    case, appearance, view, (labels, depth_mm, points) = scene
    for name, value in (("REGISTERED", 0.0), ("FAINT", 1.0), ("DEPTH_OF_FIELD", 0.0)):
        monkeypatch.setattr(projection, name, value)
    monkeypatch.setattr(SurfacePainter, "_lit", lambda _self, image, *_: image)
    painter = SurfacePainter(case.vessels, case.cortex, [appearance])
    inside, vessels = (cv2.erode((labels == label).astype(np.uint8), np.ones((3, 3))) > 0 for label in (1, 2))
    own = []
    for seed in range(12):
        image = painter.paint(labels, depth_mm, painter.overview_px(points), view, np.random.default_rng(seed))
        assert np.abs(image[inside] - np.array(RED)).mean() < 12
        share = (image[vessels].astype(float) - RED) @ np.subtract(BLUE, RED) / np.sum(np.subtract(BLUE, RED) ** 2)
        assert np.median(np.abs(share - np.median(share))) < 0.05
        own.append(np.median(share))
    assert min(own) > 0.95 * projection.FAINTEST and np.ptp(own) > 0.2


def test_light_falls_off_with_the_angle_of_the_surface(scene, monkeypatch):
    """Headlight on grey tissue: brightness follows the cosine between the mesh's normals and the viewing axis."""
    case, appearance, view, (labels, _, points) = scene
    painter = SurfacePainter(case.vessels, case.cortex, [appearance])
    monkeypatch.setattr(projection, "GLOSS", 0.0)

    class Light:  # strength 0.8 of light exactly along the axis, no blotches
        def normal(self, mean, _scale, size):
            return np.zeros(size)

        def uniform(self, low=0.0, high=1.0, size=None):
            return (high if size is None and high == 0.8 else 0.0) if size is None else np.ones(size)

        def integers(self, low, _high, size):
            return np.full(size, low)

    grey = np.full((*labels.shape, 3), 200, np.uint8)
    lit = painter._lit(grey, labels, painter.overview_px(points), view, Light())[..., 0]
    normals = case.cortex.vertex_normals()
    axis = craniotomy_of(case).outward_axis
    normals = normals * np.sign(normals @ axis).mean()
    far_from_rim = np.linalg.norm(case.cortex.vertices_mm - craniotomy_of(case).centre_world_mm, axis=1) < 8
    seen = np.flatnonzero(far_from_rim)[::3]
    brightness, expected = [], []
    for i in seen:
        at = case.camera.project((view[:3, :3] @ case.cortex.vertices_mm[i] + view[:3, 3])[None])[0]
        u, v = np.rint(at).astype(int)
        if 0 <= v < len(labels) and 0 <= u < labels.shape[1] and labels[v, u] == PARENCHYMA:
            brightness.append(lit[v, u] / 200)
            expected.append(0.2 + 0.8 * max(0.0, float(normals[i] @ -view[2, :3])))
    assert len(brightness) > 10
    assert np.abs(np.array(brightness) - expected).mean() < 0.05


def test_a_plate_holds_parenchyma_only(scene):
    _, appearance, _, _ = scene
    image, labels = files.read_image_rgb(appearance.image_path), files.read_label_map(appearance.labels_path)
    plate = parenchyma_plate(image, labels).astype(int)
    assert min(plate.shape[:2]) > 64
    assert np.abs(plate - RED).max(axis=2).mean() < 8 and (plate[..., 2] > plate[..., 0]).mean() < 0.01


def test_the_edge_of_the_craniotomy_stays_in_place_on_the_surface():
    """Another view of the same places must find the same ones open."""
    places = np.random.default_rng(0).uniform(-12, 12, (64, 64, 2)).astype(np.float32)
    shuffled = places[::-1, ::-1].copy()
    hidden = []
    for seed in range(30):
        one, two = (opening(p, np.zeros(2), 20.0, np.random.default_rng(seed)) for p in (places, shuffled))
        assert (one is None) == (two is None)
        if one is not None:
            np.testing.assert_array_equal(one, two[::-1, ::-1])
            hidden.append(1 - one.mean())
            assert one[np.linalg.norm(places, axis=2) < 3].all()
    assert 8 < len(hidden) < 22 and 0.02 < np.mean(hidden) < 0.7


def test_what_surrounds_the_surface_leaves_it_alone_and_varies():
    image = np.full((48, 48, 3), 90, np.uint8)
    outside = np.zeros((48, 48), bool)
    outside[:, 30:] = True
    cortex = np.random.default_rng(1).integers(0, 255, (40, 40, 3)).astype(np.uint8)
    filled = [fill_outside(image.copy(), outside, cortex, np.random.default_rng(seed)) for seed in range(24)]
    assert all((f[~outside] == 90).all() for f in filled)
    means = {tuple(f[outside].mean(axis=0).round()) for f in filled}
    assert (0.0, 0.0, 0.0) in means and len(means) > 8


def test_impostors_are_not_the_image():
    rng = np.random.default_rng(2)
    image = cv2.GaussianBlur(rng.integers(0, 255, (64, 64, 3)).astype(np.uint8), (0, 0), 3)
    turns = [np.rot90(image, k).astype(int) for k in range(4)]
    for seed in range(20):
        other = impostor(image, np.random.default_rng(seed))
        assert other.shape == image.shape and other.dtype == np.uint8
        assert min(np.abs(other - t).mean() for t in turns) > 3


def test_tissue_goes_on_beyond_the_rim_without_a_seam_and_each_time_elsewhere(monkeypatch):
    monkeypatch.setattr("ExpectedAppearancesLib.augmentation.surroundings.EVERYWHERE", 0.0)
    rows, columns = np.mgrid[:96, :128]
    inside = (np.hypot(rows - 48, columns - 60) < 25).astype(np.uint8)
    tissue = np.full((96, 128, 3), (180, 90, 80), np.uint8)
    tissue[columns[:, :] % 8 < 2] = (150, 60, 60)
    seen = tissue * inside[..., None]
    areas = []
    for seed in range(12):
        image, where = continue_tissue(seen.copy(), inside, np.random.default_rng(seed))
        assert where[inside > 0].all()
        assert image[where].min() > 50  # no black rim left between the old tissue and the new
        deep = cv2.erode(inside, np.ones((9, 9))) > 0
        np.testing.assert_array_equal(image[deep], seen[deep])
        assert not image[~where & (inside == 0)].any()
        areas.append(where.sum() / inside.sum())
    assert min(areas) < 1.15 and max(areas) > 1.5


def test_a_view_full_of_tissue_or_without_any_is_left_as_it_is():
    image = np.full((32, 32, 3), 7, np.uint8)
    for inside in (np.ones((32, 32), np.uint8), np.zeros((32, 32), np.uint8)):
        same, where = continue_tissue(image.copy(), inside, np.random.default_rng(0))
        np.testing.assert_array_equal(same, image)
        np.testing.assert_array_equal(where, inside > 0)
