from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ExpectedAppearancesLib.augmentation.microscope import DEFAULT, NO_CHANGE, MicroscopeLook, apply


def brain_like(size=64):
    """Pinkish image with a dark diagonal vessel."""
    y, x = np.mgrid[:size, :size]
    image = np.empty((size, size, 3), np.uint8)
    image[:] = (180, 120, 110)
    image[np.abs(x - y) < 4] = (90, 40, 60)
    return image


def looked(seed=0, image=None, **changes):
    return apply(brain_like() if image is None else image, np.random.default_rng(seed), replace(NO_CHANGE, **changes))


def test_a_look_without_change_is_the_identity():
    image = np.random.default_rng(0).integers(0, 256, (33, 47, 3), dtype=np.uint8)
    np.testing.assert_array_equal(apply(image, np.random.default_rng(1), NO_CHANGE), image)


def test_default_look_repeats_by_seed_varies_and_leaves_the_input_alone():
    image = brain_like()
    kept = image.copy()
    results = [apply(image, np.random.default_rng(seed), DEFAULT) for seed in range(30)]
    np.testing.assert_array_equal(image, kept)
    np.testing.assert_array_equal(results[4], apply(image, np.random.default_rng(4), DEFAULT))
    assert all(result.shape == image.shape and result.dtype == np.uint8 for result in results)
    assert np.std([result.mean() for result in results]) > 15
    hues = np.array([result.mean((0, 1)) / result.mean() for result in results])
    assert (hues.std(0) > 0.08).all()


def test_the_vessel_stays_where_it_is_and_darker_than_its_surroundings():
    y, x = np.mgrid[:64, :64]
    vessel, beside = np.abs(x - y) < 2, np.abs(x - y) > 8
    contrasts = [
        float(result[beside].mean() - result[vessel].mean())
        for result in (apply(brain_like(), np.random.default_rng(seed)) for seed in range(60))
    ]
    assert np.mean(np.array(contrasts) > 5) > 0.9


def test_one_stop_doubles_the_light():
    image = np.full((16, 16, 3), 60, np.uint8)
    np.testing.assert_allclose(looked(image=image, exposure_stops=(1, 1)), 120, atol=1)


def test_contrast_is_stretched_about_the_mean():
    image = np.full((16, 16, 3), 100, np.uint8)
    image[8:] = 140
    result = looked(image=image, contrast=(1.5, 1.5))
    assert (result[0, 0, 0], result[15, 0, 0]) == (90, 150)


def test_gamma_is_the_power_of_the_relative_value():
    image = np.full((16, 16, 3), 64, np.uint8)
    np.testing.assert_allclose(looked(image=image, gamma=(2, 2)), 255 * (64 / 255) ** 2, atol=1)


def test_white_balance_acts_on_channels_and_hue_turns_red_into_green():
    red = np.zeros((8, 8, 3), np.uint8)
    red[..., 0] = 100
    turned = looked(image=red, hue_deg=(120, 120))
    np.testing.assert_allclose(turned[0, 0], (0, 100, 0), atol=1)
    grey = np.full((8, 8, 3), 100, np.uint8)
    np.testing.assert_allclose(looked(image=grey, hue_deg=(70, 70), saturation=(2, 2)), 100, atol=1)
    assert np.ptp(looked(image=grey, white_balance=(0.7, 1.4))[0, 0]) > 5


def test_noise_has_the_asked_deviation_and_no_bias():
    image = np.full((128, 128, 3), 128, np.uint8)
    noisy = looked(image=image, noise=(0.04, 0.04)).astype(float)
    assert noisy.std() == pytest.approx(0.04 * 255, rel=0.03) and noisy.mean() == pytest.approx(128, abs=0.3)


def test_vignetting_darkens_corners_not_the_middle():
    image = np.full((65, 65, 3), 200, np.uint8)
    result = looked(image=image, vignetting=(0.5, 0.5))
    assert result[32, 32, 0] >= 199 and abs(int(result[0, 0, 0]) - 100) <= 2


def test_blur_keeps_the_mean_and_softens_the_edge():
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, 32:] = 200
    for changes in ({"defocus": (0.03, 0.03)}, {"motion": (0.1, 0.1), "motion_probability": 1.0}):
        result = looked(image=image, **changes).astype(int)
        assert np.abs(np.diff(result[32, :, 0])).max() < 150
        assert abs(result[:, 16:48].mean() - 100) < 3


@pytest.mark.parametrize(
    "changes", [{"specular_probability": 1.0}, {"blood_probability": 1.0}, {"instrument_probability": 1.0}]
)
def test_occluders_are_local(changes):
    changed = [(np.abs(looked(seed, **changes).astype(int) - brain_like()) > 3).any(2).mean() for seed in range(20)]
    assert 0 < np.mean(changed) < 0.35


def test_instruments_are_of_all_widths_and_more_often_thin():
    image = np.full((128, 128, 3), (180, 90, 90), np.uint8)
    shares = []
    for seed in range(60):
        changed = np.abs(looked(seed, image, instrument_probability=1.0).astype(int) - image).max(axis=2) > 8
        shares.append(changed.mean())
    assert np.median(shares) < 0.1 < np.quantile(shares, 0.8) and max(shares) > 0.15


def test_circular_field_is_black_outside():
    image = np.full((100, 100, 3), 200, np.uint8)
    result = looked(image=image, circular_field=(0.4, 0.4), circular_field_probability=1)
    assert not result[[0, 0, -1, -1], [0, -1, 0, -1]].any() and result[50, 50].tolist() == [200] * 3
    assert (result[..., 0] > 100).mean() == pytest.approx(np.pi * 0.4**2, rel=0.05)


def test_jpeg_changes_little_and_keeps_the_channel_order():
    result = looked(jpeg_probability=1.0, jpeg_quality=(90, 90)).astype(int)
    assert 0 < np.abs(result - brain_like()).mean() < 6


def test_nonsense_is_refused():
    with pytest.raises(ValueError, match="gamma"):
        MicroscopeLook(gamma=(2, 1))
    with pytest.raises(ValueError, match="jpeg_probability"):
        MicroscopeLook(jpeg_probability=1.5)
    with pytest.raises(ValueError, match="uint8"):
        apply(np.zeros((8, 8, 3), np.float32), np.random.default_rng(0))


@pytest.mark.parametrize("name", ["sponge_probability", "retractor_probability"])
def test_what_lies_on_the_cortex_covers_a_part_of_it_and_no_more(name):
    image = np.full((96, 96, 3), (180, 90, 90), np.uint8)
    covered = []
    for seed in range(20):
        result = apply(image, np.random.default_rng(seed), replace(NO_CHANGE, **{name: 1.0}))
        covered.append((np.abs(result.astype(int) - image).max(axis=2) > 8).mean())
    assert 0.01 < np.mean(covered) < 0.3 and max(covered) < 0.6 and np.std(covered) > 0.005


def test_the_usual_look_is_mild_in_most_images_and_strong_in_some():
    image = np.full((32, 32, 3), 120, np.uint8)
    change = [np.abs(apply(image, np.random.default_rng(seed)).astype(int) - 120).mean() for seed in range(200)]
    assert np.quantile(change, 0.25) < 25 and np.quantile(change, 0.95) > 45
