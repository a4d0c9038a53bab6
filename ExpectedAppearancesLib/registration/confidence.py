"""Calibrated probability that ADD < 3 mm, learnt on synthetic validation views, and the threshold for refusal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GOOD_ADD_MM = 3.0
PRECISION_WANTED = 0.99  # of accepted validation views, negatives among them
BINS = 10  # of confidence, for its reliability
LEAST_PROBABILITY = 0.9  # of any single accepted frame, however well the sure ones make up for it


def logistic(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)), without overflow."""
    return 1 / (1 + np.exp(-np.clip(x, -40, 40)))


@dataclass(frozen=True)
class Confidence:
    """Logistic model over standardised evidence: weights (F,), bias; evidence mean and scale (F,); threshold."""

    mean: np.ndarray
    scale: np.ndarray
    weights: np.ndarray
    bias: float
    threshold: float

    def probability(self, evidence: np.ndarray | None) -> float:
        """Probability that ADD < 3 mm; 0 without evidence of a pose."""
        if evidence is None:
            return 0.0
        # Evidence far outside what validation showed must not push confidence beyond what was seen there.
        standard = np.clip((evidence - self.mean) / self.scale, -4, 4)
        return float(logistic(standard @ self.weights + self.bias))

    def to_dict(self) -> dict:
        return {key: np.asarray(value).tolist() for key, value in vars(self).items()}

    @staticmethod
    def from_dict(values: dict) -> Confidence:
        arrays = {key: np.array(values[key], float) for key in ("mean", "scale", "weights")}
        return Confidence(bias=float(values["bias"]), threshold=float(values["threshold"]), **arrays)


def calibrate(evidence: np.ndarray, good: np.ndarray) -> Confidence:
    """Fit on validation views: evidence (N, F), good (N,) bool. Penalised logistic regression by Newton's method."""
    count, features = evidence.shape
    mean = evidence.mean(axis=0) if count else np.zeros(features)
    scale = evidence.std(axis=0) + 1e-6 if count else np.ones(features)
    design = np.hstack([np.clip((evidence - mean) / scale, -4, 4), np.ones((count, 1))])
    penalty = np.diag([1.0] * features + [1e-3])
    target = (good * (good.sum() + 1.0) + ~good * 1.0) / (np.where(good, good.sum(), (~good).sum()) + 2.0)
    beta = np.zeros(features + 1)
    for _ in range(50):
        probability = logistic(design @ beta)
        gradient = design.T @ (probability - target) + penalty @ beta
        hessian = (design * (probability * (1 - probability))[:, None]).T @ design + penalty
        step = np.linalg.solve(hessian, gradient)
        beta -= step
        if np.abs(step).max() < 1e-8:
            break
    probability = logistic(design @ beta)
    return Confidence(mean, scale, beta[:-1], float(beta[-1]), _threshold(probability, good))


def _threshold(probability: np.ndarray, good: np.ndarray) -> float:
    """The lowest threshold at which accepted views are good often enough, at least LEAST_PROBABILITY, at most 0.99:
    where even that lets more wrong ones through, the model's figures of validation say so."""
    order = np.argsort(-probability)
    precision = np.cumsum(good[order]) / np.arange(1, len(order) + 1)
    enough = np.nonzero(precision >= PRECISION_WANTED)[0]
    if not len(enough):
        return 0.99
    return float(min(max(probability[order[enough[-1]]], LEAST_PROBABILITY), 0.99))


def bin_of(probability: np.ndarray) -> np.ndarray:
    """In which of BINS equal ranges each probability (N,), 0..1, lies."""
    return np.minimum((probability * BINS).astype(int), BINS - 1)


def calibration_error(probability: np.ndarray, good: np.ndarray) -> float:
    """Expected calibration error: mean gap between probability and share of good ones, weighted by bin size."""
    which = bin_of(probability)
    gaps = [abs(probability[which == b].mean() - good[which == b].mean()) * (which == b).sum() for b in set(which)]
    return float(sum(gaps) / max(1, len(probability)))
