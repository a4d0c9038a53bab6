"""The Lie group of rigid poses SE(3). A twist (6,) is (rotation vector, rad; translation, mm), in this order.

Formulas: T. Barfoot, State Estimation for Robotics (2017), chapter 7, with rotation first.
"""

from __future__ import annotations

import numpy as np

from .pose import pose_from_rotation, rotation_matrix, rotation_vector

_SERIES_TERMS = 40  # the terms shrink faster than pi^n / n!; 40 are exact to rounding


def exp(twist: np.ndarray) -> np.ndarray:
    """Twist (6,) -> pose (4, 4)."""
    twist = np.asarray(twist, float)
    return pose_from_rotation(rotation_matrix(twist[:3]), _turning(twist[:3]) @ twist[3:])


def log(pose: np.ndarray) -> np.ndarray:
    """Pose (4, 4) -> twist (6,) whose rotation is at most pi rad; the inverse of `exp`."""
    vector = rotation_vector(pose[:3, :3])
    return np.concatenate([vector, np.linalg.solve(_turning(vector), pose[:3, 3])])


def adjoint(pose: np.ndarray) -> np.ndarray:
    """(6, 6), for which pose exp(twist) = exp(adjoint(pose) twist) pose."""
    rotation = pose[:3, :3]
    result = np.zeros((6, 6))
    result[:3, :3] = result[3:, 3:] = rotation
    result[3:, :3] = cross_matrix(pose[:3, 3]) @ rotation
    return result


def right_jacobian(twist: np.ndarray) -> np.ndarray:
    """(6, 6) J, for which exp(twist + d) = exp(twist) exp(J d) to first order in d; rotations of at most pi rad."""
    twist = np.asarray(twist, float)
    bracket = np.zeros((6, 6))
    bracket[:3, :3] = bracket[3:, 3:] = cross_matrix(twist[:3])
    bracket[3:, :3] = cross_matrix(twist[3:])
    return _series(-bracket)


def cross_matrix(vector: np.ndarray) -> np.ndarray:
    """(3, 3) whose product with b is the cross product of vector (3,) and b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _turning(rotation_vector_rad: np.ndarray) -> np.ndarray:
    """(3, 3): mean of the rotations on the way to this one, so that translation is carried along a screw."""
    return _series(cross_matrix(rotation_vector_rad))


def _series(matrix: np.ndarray) -> np.ndarray:
    """Sum of matrix^n / (n + 1)!, n = 0, 1, ...: without the small divisors that closed forms have near no rotation."""
    term = total = np.eye(len(matrix))
    for n in range(1, _SERIES_TERMS):
        term = term @ matrix / (n + 1)
        total = total + term
        if np.abs(term).max() < 1e-17:
            break
    return total
