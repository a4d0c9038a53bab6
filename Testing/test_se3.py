from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from ExpectedAppearancesLib.geometry import se3
from ExpectedAppearancesLib.geometry.pose import inverse, is_rigid

RNG = np.random.default_rng(0)
# Turns from none over tiny ones to nearly pi, each with a translation of many mm.
ANGLES = [0.0, 1e-9, 1e-4, 0.3, 2.0, 3.1]


def twist_of(angle: float) -> np.ndarray:
    axis = np.array([2.0, -1.0, 0.5])
    return np.concatenate([angle * axis / np.linalg.norm(axis), [40.0, -7.0, 110.0]])


def bracket(twist: np.ndarray) -> np.ndarray:
    """The twist as a 4x4 matrix, written out from its definition."""
    (a, b, c), (x, y, z) = twist[:3], twist[3:]
    return np.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0.0]])


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_is_that_of_the_matrix_and_log_undoes_it(angle):
    twist = twist_of(angle)
    pose = se3.exp(twist)
    assert is_rigid(pose, 1e-9)
    np.testing.assert_allclose(pose, expm(bracket(twist)), atol=1e-9)
    np.testing.assert_allclose(se3.log(pose), twist, atol=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_adjoint_carries_a_twist_through_a_pose(angle):
    pose, twist = se3.exp(twist_of(angle)), RNG.normal(size=6) * [0.3, 0.3, 0.3, 5, 5, 5]
    expected = pose @ expm(bracket(twist)) @ inverse(pose)
    np.testing.assert_allclose(se3.exp(se3.adjoint(pose) @ twist), expected, atol=1e-9)


@pytest.mark.parametrize("angle", ANGLES)
def test_right_jacobian_is_the_derivative_of_the_exponential(angle):
    twist = twist_of(angle)
    back = inverse(expm(bracket(twist)))
    step = 1e-5
    slopes = []
    for axis in np.eye(6):
        ahead, behind = (back @ expm(bracket(twist + sign * step * axis)) for sign in (1, -1))
        slope = (ahead - behind) / (2 * step)
        slopes.append([slope[2, 1], slope[0, 2], slope[1, 0], *slope[:3, 3]])
    np.testing.assert_allclose(se3.right_jacobian(twist), np.transpose(slopes), atol=1e-6)


def test_cross_matrix():
    a, b = RNG.normal(size=(2, 3))
    np.testing.assert_allclose(se3.cross_matrix(a) @ b, np.cross(a, b))
