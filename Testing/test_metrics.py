from __future__ import annotations

import json
import math

import numpy as np
import pytest

from ExpectedAppearancesLib.evaluation import metrics
from ExpectedAppearancesLib.geometry.displacement import add_mm
from ExpectedAppearancesLib.geometry.pose import rotation_matrix

# Corners of a cube of side 20 mm about (100, -50, 30): far from the world origin, as scans are.
CENTROID = np.array([100.0, -50.0, 30.0])
CUBE = CENTROID + 10.0 * np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])


def pose(rotation_vector=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)):
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = rotation_matrix(np.array(rotation_vector)), translation
    return result


TRUE = pose((0.3, -1.2, 0.5), (5.0, 10.0, 250.0))


def moved_in_camera(step_mm):
    return pose(translation=step_mm) @ TRUE


def turned_about_centroid(axis, angle_rad):
    """The true pose after a rotation about the mesh centroid, about an axis of the camera frame."""
    centre = TRUE[:3, :3] @ CENTROID + TRUE[:3, 3]
    turn = pose(angle_rad * np.array(axis, float))
    return pose(translation=centre) @ turn @ pose(translation=-centre) @ TRUE


def errors_of(*predicted, accepted=None):
    return metrics.frame_errors(CUBE, [TRUE] * len(predicted), predicted, accepted)


def errors_with(add=(), rotation=None, translation=None, accepted=None):
    add = np.array(add, float)
    rotation = add if rotation is None else np.array(rotation, float)
    translation = add if translation is None else np.array(translation, float)
    accepted = ~np.isnan(add) if accepted is None else np.array(accepted)
    return metrics.FrameErrors(add, add, add, rotation, translation, accepted)


def test_pure_translation_moves_every_vertex_alike():
    errors = errors_of(TRUE, moved_in_camera((3, 4, 0)), moved_in_camera((0, 0, -2)), moved_in_camera((2, 3, 6)))
    np.testing.assert_allclose(errors.add_mm, (0, 5, 2, 7), atol=1e-9)
    np.testing.assert_allclose(errors.translation_mm, (0, 5, 2, 7), atol=1e-9)
    np.testing.assert_allclose(errors.lateral_mm, (0, 5, 0, math.sqrt(13)), atol=1e-9)
    np.testing.assert_allclose(errors.depth_mm, (0, 0, 2, 6), atol=1e-9)
    np.testing.assert_allclose(errors.rotation_deg, 0, atol=1e-5)


def test_rotation_about_the_centroid_is_no_translation():
    """Corners of the cube turned about an axis of its own: the chord 2 r sin(angle / 2), r their distance to it."""
    angle = math.radians(30)
    axis_in_camera = TRUE[:3, :3] @ (0, 0, 1)
    (errors,) = [errors_of(turned_about_centroid(axis_in_camera, angle))]
    assert errors.add_mm[0] == pytest.approx(2 * 10 * math.sqrt(2) * math.sin(angle / 2))
    assert errors.translation_mm[0] == pytest.approx(0, abs=1e-9)
    assert errors.rotation_deg[0] == pytest.approx(30)


def test_rotation_about_the_optical_axis_has_no_depth_part():
    errors = errors_of(turned_about_centroid((0, 0, 1), 0.4), turned_about_centroid((1, 0, 0), 0.4))
    assert errors.depth_mm[0] == pytest.approx(0, abs=1e-9) and errors.lateral_mm[0] == pytest.approx(errors.add_mm[0])
    assert errors.depth_mm[1] > 1


def test_half_turn_is_180_degrees_not_nan():
    assert errors_of(turned_about_centroid((0, 1, 0), math.pi)).rotation_deg[0] == pytest.approx(180)


def test_errors_equal_a_slow_reference_on_random_poses():
    rng = np.random.default_rng(0)
    vertices = rng.normal((10, 200, -30), 20, (50, 3))
    true, predicted = ([pose(rng.normal(0, 1, 3), rng.normal(0, 50, 3)) for _ in range(6)] for _ in range(2))
    errors = metrics.frame_errors(vertices, true, predicted)
    for i in range(6):
        lengths, lateral, depth = [], [], []
        for x in vertices:
            d = (true[i] @ [*x, 1.0])[:3] - (predicted[i] @ [*x, 1.0])[:3]
            lengths.append(math.dist(d, (0, 0, 0)))
            lateral.append(math.hypot(d[0], d[1]))
            depth.append(abs(d[2]))
        relative = true[i][:3, :3] @ predicted[i][:3, :3].T
        centre = np.append(vertices.mean(axis=0), 1.0)
        assert errors.add_mm[i] == pytest.approx(np.mean(lengths))
        assert errors.lateral_mm[i] == pytest.approx(np.mean(lateral))
        assert errors.depth_mm[i] == pytest.approx(np.mean(depth))
        assert errors.rotation_deg[i] == pytest.approx(math.degrees(math.acos((np.trace(relative) - 1) / 2)))
        assert errors.translation_mm[i] == pytest.approx(math.dist((true[i] @ centre)[:3], (predicted[i] @ centre)[:3]))
    np.testing.assert_allclose(add_mm(vertices, np.array(true), np.array(predicted)), errors.add_mm)


def test_accuracy_needs_both_and_is_strict():
    errors = errors_with([0] * 4, rotation=[2.9, 2.9, 3.1, 3.0], translation=[2.9, 3.1, 2.9, 2.0])
    assert metrics.accuracy(errors, 3) == 0.25
    assert metrics.accuracy(errors, 5) == 1.0


def test_auc_is_the_area_under_the_curve():
    errors = errors_with([0.0, 5.0, 12.5, 40.0, np.nan])
    limits = np.linspace(0, 20, 20001)
    area = np.mean([metrics.add_accuracy(errors, limit) for limit in limits])
    assert metrics.add_auc(errors) == pytest.approx(area, abs=1e-3)
    assert metrics.add_auc(errors) == pytest.approx((1 + 0.75 + 0.375) / 5)


def test_frames_without_a_pose_are_misses_and_not_in_the_means():
    refused_far = moved_in_camera((100, 0, 0))
    errors = errors_of(moved_in_camera((1, 0, 0)), None, refused_far, accepted=[True, False, False])
    result = metrics.metrics(errors, ["a", "a", "a"])
    assert (result["frames"], result["refused"], result["without_pose"]) == (3, 2, 1)
    assert result["add_mm"]["mean"] == pytest.approx(50.5)
    assert result["accuracy"]["3mm-3deg"] == pytest.approx(1 / 3)
    accepted = result["accepted_only"]
    assert (accepted["frames"], accepted["refused"]) == (1, 0)
    assert accepted["add_mm"]["mean"] == pytest.approx(1) and accepted["accuracy"]["3mm-3deg"] == 1


def test_a_pose_less_frame_is_never_accepted():
    assert not errors_of(None, accepted=[True]).accepted[0]


def test_quantiles_and_styles_have_the_promised_keys():
    values = [*range(1, 21), 3.0]
    result = metrics.metrics(errors_with(values), ["x"] * 20 + [None])
    assert result["add_mm"]["median"] == 10 and result["add_mm"]["p95"] == pytest.approx(np.percentile(values, 95))
    assert set(result["add_mm"]) == {"mean", "median", "p95", "lateral_mean", "depth_mean"}
    assert set(result["accuracy"]) == {"3mm-3deg", "5mm-5deg"}
    assert set(result["styles"]) == {"x", "no style"} and result["styles"]["no style"]["frames"] == 1
    assert set(result["styles"]["x"]) == set(result) - {"styles"}
    json.dumps(result, allow_nan=False)


def test_nothing_registered_gives_no_figures_rather_than_nan():
    result = metrics.metrics(errors_of(None, None), [None, None])
    assert result["add_mm"]["mean"] is None and result["accuracy"]["3mm-3deg"] == 0 and result["add_auc_20mm"] == 0
    assert result["accepted_only"]["frames"] == 0 and result["accepted_only"]["accuracy"]["3mm-3deg"] is None
    json.dumps(result, allow_nan=False)


def test_lists_of_different_length_are_refused():
    with pytest.raises(ValueError, match="not the same frames"):
        metrics.frame_errors(CUBE, [TRUE], [TRUE, TRUE])


def test_mean_pose_lies_in_the_middle():
    both = [turned_about_centroid((1, 0, 0), 0.3), turned_about_centroid((1, 0, 0), -0.3)]
    np.testing.assert_allclose(metrics.mean_pose(CUBE, both), TRUE, atol=1e-9)
    both = [moved_in_camera((0, 0, 8)), moved_in_camera((0, 2, 0))]
    np.testing.assert_allclose(metrics.mean_pose(CUBE, both), moved_in_camera((0, 1, 4)), atol=1e-9)


def test_reliability_of_confidences_that_mean_what_they_say_and_of_boasts():
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0, 1, 20_000)
    good = rng.uniform(size=20_000) < confidence
    vertices = np.zeros((1, 3))
    poses = [pose(translation=(0 if g else 5, 0, 100)) for g in good]
    errors = metrics.frame_errors(vertices, [pose(translation=(0, 0, 100))] * 20_000, poses)
    honest = metrics.reliability(confidence, errors)
    assert honest["expected_calibration_error"] < 0.02 and sum(row["frames"] for row in honest["bins"]) == 20_000
    assert all(abs(row["confidence"] - row["add_below_3mm"]) < 0.05 for row in honest["bins"])
    boasts = metrics.reliability(np.ones(20_000), errors)
    (row,) = boasts["bins"]
    assert row["from"] == 0.9 and row["add_below_3mm"] == pytest.approx(good.mean())
    assert boasts["expected_calibration_error"] == pytest.approx(1 - good.mean())


def test_nearest_other_pose_against_plain_distances():
    poses = [pose(translation=(x, 0, 100)) for x in (0.0, 3.0, 10.0)]
    assert sorted(metrics.nearest_other_pose_add_mm(CUBE, [*poses, poses[0]])) == pytest.approx([3, 3, 7])
    assert len(metrics.nearest_other_pose_add_mm(CUBE, poses[:1])) == 0
