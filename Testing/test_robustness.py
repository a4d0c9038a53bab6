"""Disturbances have the strength that they say, and the robustness table counts right."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np
import pytest

from ExpectedAppearancesLib import files
from ExpectedAppearancesLib.evaluation import perturbations
from ExpectedAppearancesLib.evaluation.robustness import choose, example_sheet, robustness_table
from ExpectedAppearancesLib.geometry.camera import Camera
from ExpectedAppearancesLib.geometry.pose import look_at, pose_from_rotation, transform
from ExpectedAppearancesLib.registration.poses_file import Frame

CAMERA = Camera(96, 80, 180.0, 180.0, 47.5, 39.5)
VERTICES = np.random.default_rng(3).uniform(-10, 10, (50, 3))


def frame_image(size=(200, 240)) -> np.ndarray:
    """A lit disc on black, mid-grey with a little structure."""
    rows, columns = np.mgrid[: size[0], : size[1]]
    lit = np.hypot(rows - 110, columns - 100) < 85
    grey = 120 + 10 * np.sin(columns / 7) * np.cos(rows / 9)
    return (np.repeat(grey[..., None], 3, axis=2) * lit[..., None]).astype(np.uint8)


def rng(i: int = 0) -> np.random.Generator:
    return np.random.default_rng([5, i])


@pytest.mark.parametrize("name", ["instrument", "blood", "sponge"])
def test_occlusion_hides_the_stated_share_of_the_lit_field_and_grows(name):
    image = frame_image()
    lit = image.any(axis=2)
    brighter = np.where(lit[..., None], image + 80, 0).astype(np.uint8)
    for seed in range(5):
        hidden = []
        for percent in (10, 20, 30, 40):
            # Hidden is where nothing of the image behind shows.
            both = [getattr(perturbations, name)(i, percent, rng(seed)).astype(int) for i in (image, brighter)]
            hidden.append((np.abs(both[0] - both[1]).max(axis=2) < 20) & lit)
            assert 100 * hidden[-1].sum() / lit.sum() == pytest.approx(percent, abs=4)
        assert all((a & ~b).sum() < 0.01 * lit.sum() for a, b in itertools.pairwise(hidden))


def test_photometric_strengths_against_formulas():
    grey = np.full((64, 64, 3), 64, np.uint8)
    for stops in (-2, -1, 1):
        assert perturbations.exposure(grey, stops, rng())[0, 0, 0] == pytest.approx(64 * 2 ** (stops / 2.2), abs=0.6)
    assert perturbations.exposure(np.full((4, 4, 3), 200, np.uint8), 2, rng()).min() == 255
    assert perturbations.white_balance(grey, 25, rng())[0, 0].tolist() == [80, 64, 48]
    assert perturbations.noise(grey, 5, rng()).astype(float).std() == pytest.approx(12.75, rel=0.05)
    sizes = [np.abs(perturbations.jpeg(frame_image(), q, rng()).astype(int) - frame_image()).mean() for q in (50, 10)]
    assert 0 < sizes[0] < sizes[1] < 10
    assert (perturbations.specular_spots(frame_image(), 30, rng()) > 240).all(axis=2).sum() > 100


def test_blurs_have_the_stated_width():
    point = np.zeros((201, 201, 3), np.uint8)
    point[96:105, 96:105] = 250
    own = 9**2 / 12
    rows, columns = np.mgrid[:201, :201] - 100.0

    def second_moments(image):
        weight = image[..., 0] / image[..., 0].sum()
        return (weight * rows**2).sum(), (weight * columns**2).sum()

    # Rounding to bytes cuts the tails of the Gaussian.
    assert sum(second_moments(perturbations.defocus(point, 1.0, rng()))) / 2 - own == pytest.approx(2.01**2, rel=0.15)
    for seed in range(3):
        spread = sum(second_moments(perturbations.motion_blur(point, 10, rng(seed)))) - 2 * own
        assert spread == pytest.approx(20.1**2 / 12, rel=0.1)


def test_brain_shift_has_its_length_no_affine_part_and_does_not_fold():
    lit = frame_image((256, 256)).any(axis=2)
    y, x = np.mgrid[:256, :256].astype(float)
    design = np.stack([np.ones_like(x), x, y], axis=-1)[lit]
    for seed in range(8):
        for share in (0.04, 0.1, 0.22):  # 2, 5 and 10 mm of a field 46 mm wide
            length_px = share * np.sqrt(lit.sum())
            field = perturbations.shift_field(lit, length_px, rng(seed)).astype(float)
            assert np.linalg.norm(field[lit], axis=1).max() == pytest.approx(length_px, rel=1e-4)
            assert np.abs(np.linalg.lstsq(design, field[lit], rcond=None)[0]).max() < 1e-4
            (xx, xy), (yx, yy) = ((np.gradient(field[..., k], axis=a)[lit] for a in (1, 0)) for k in (0, 1))
            assert ((1 + xx) * (1 + yy) - xy * yx).min() > 0
    assert (perturbations.brain_shift(frame_image(), 0.0, rng()) == frame_image()).all()


def known_frames(folder, styles="ab", count=4) -> list[Frame]:
    frames = []
    for style in styles:
        for i in range(count):
            path = folder / style / f"{i}.png"
            files.write_png(path, frame_image((160, 192)))
            pose = look_at(np.array([3.0 * i - 8, 5.0, 80.0 + i]), np.zeros(3), np.array([0.0, 1.0, 0.0]))
            frames.append(Frame(path, pose, style))
    return frames


class FocalPredictor:
    """Off by a millimetre for each percent that the focal length is wrong; refuses above 4 %. Never quite sure."""

    def __init__(self, poses, style):
        self.poses, self.style = list(poses), style

    def predict(self, _image, told):
        percent = 100 * abs(told.fx / 360.0 - 1)
        pose = self.poses.pop(0)
        self.poses.append(pose)
        moved = pose_from_rotation(np.eye(3), (0, percent, 0)) @ pose
        return SimpleNamespace(camera_from_world=moved, accepted=percent < 4, confidence=0.73)


def test_table_against_hand_computation(tmp_path):
    frames = known_frames(tmp_path)
    predictors = {
        s: FocalPredictor([f.camera_from_world for f in choose(frames, 8, 1) if f.style == s], s) for s in "ab"
    }
    steps = []
    table = robustness_table(
        VERTICES, CAMERA, frames, predictors.__getitem__, "stand-in", 80, 1, lambda f, _text: steps.append(f)
    )
    assert table["frames"] == 8 and table["undisturbed"]["add_mm"]["mean"] == pytest.approx(0, abs=1e-9)
    assert steps == sorted(steps) and steps[-1] == 1
    wanted = {"-10 %": 10, "-5 %": 5, "-1 %": 1, "+1 %": 1, "+5 %": 5, "+10 %": 10}
    by_strength = {r["strength"]: r["metrics"] for r in table["rows"] if r["kind"] == "focal length given wrong"}
    assert {k: m["add_mm"]["mean"] for k, m in by_strength.items()} == pytest.approx(wanted)
    assert {k: m["refused"] for k, m in by_strength.items()} == {k: 8 * (v > 4) for k, v in wanted.items()}
    assert by_strength["+1 %"]["accepted_add_below_3mm"] == 1 and by_strength["+5 %"]["accepted_add_below_3mm"] is None
    # Of all that have another image, and every pose of those is right; a wrong focal length no image shows.
    disturbed = 8 * (len(table["rows"]) - len(wanted))
    assert [(b["frames"], b["add_below_3mm"]) for b in table["reliability"]["bins"]] == [(disturbed, 1.0)]
    assert table["reliability"]["expected_calibration_error"] == pytest.approx(0.27)
    kinds = {row["kind"] for row in table["rows"]}
    assert len(kinds) == 12 and {"brain shift", "JPEG", "exposure", "occlusion by sponge"} <= kinds


def test_every_disturbance_but_the_camera_changes_the_image_and_the_same_seed_gives_the_same():
    state = perturbations.FrameState(frame_image(), CAMERA, 4.0)
    for row in perturbations.perturbations():
        image, told = row.apply(state, rng(1))
        again, _ = row.apply(state, rng(1))
        assert image.dtype == np.uint8 and image.shape == state.image.shape and (image == again).all()
        assert (told == CAMERA) != (image == state.image).all()


def test_brain_shift_in_millimetres_is_that_at_the_vessels_depth(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(perturbations, "brain_shift", lambda image, px, _rng: seen.append(px) or image)
    (frame,) = known_frames(tmp_path, "a", 1)
    row = [p for p in perturbations.perturbations() if p.strength == "5 mm"]
    predictor = FocalPredictor([frame.camera_from_world], "a")
    robustness_table(VERTICES, CAMERA, [frame], lambda _style: predictor, "stand-in", rows=row)
    depth = transform(frame.camera_from_world, VERTICES.mean(axis=0)[None])[0, 2]
    assert seen == [pytest.approx(5 * 360.0 / depth)]


def test_chosen_frames_are_spread_over_styles_and_repeatable(tmp_path):
    frames = known_frames(tmp_path, "abc", 6)
    chosen = choose(frames, 7, 0)
    assert sorted(sum(f.style == s for f in chosen) for s in "abc") == [2, 2, 3]
    assert [f.image for f in chosen] == [f.image for f in choose(frames, 7, 0)]
    assert [f.image for f in chosen] != [f.image for f in choose(frames, 7, 1)]
    assert len(choose(frames, 80, 0)) == 18


def test_examples_show_the_disturbances(tmp_path):
    picture = example_sheet(known_frames(tmp_path, "a", 1)[0], CAMERA, VERTICES)
    assert picture.ndim == 3 and picture.std() > 10
