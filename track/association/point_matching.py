"""One-to-one matching of points with markers by log-odds, and how certain each match is."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment


def match_log_odds(
    points: Float[np.ndarray, "P 3"],
    positions: Float[np.ndarray, "K 3"],
    covariances: Float[np.ndarray, "K 3 3"],
    stray_density: float,
) -> Float[np.ndarray, "P K"]:
    """Log-odds of each point being a marker rather than a stray.

    Args:
        points: Points [m].
        positions: Predicted positions of markers [m].
        covariances: Covariances of these [m^2].
        stray_density: See `AssociationConfig` [1/m^3].
    """
    innovation = points[:, None] - positions
    precision = np.linalg.inv(covariances)
    square = np.einsum("pki,kij,pkj->pk", innovation, precision, innovation)
    log_odds: np.ndarray = (
        0.5 * np.log(np.linalg.det(precision)) - 0.5 * square - _stray_log_density(stray_density)
    )
    return log_odds


def peak_log_odds(variances: Float[np.ndarray, "K"], stray_density: float) -> Float[np.ndarray, "K"]:
    """Log-odds of a point exactly at the predicted position of a marker.

    Args:
        variances: Variance of each marker in each direction [m^2].
        stray_density: See `AssociationConfig` [1/m^3].
    """
    log_odds: np.ndarray = -1.5 * np.log(variances) - _stray_log_density(stray_density)
    return log_odds


def match_points(
    log_odds: Float[np.ndarray, "P K"],
) -> tuple[Int[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """The most likely assignment of points to markers, one to one; either may stay alone.

    Args:
        log_odds: Log-odds of each pair.

    Returns:
        Marker of each point, -1 for none, and the confidence in it [0, 1], which weighs the alternatives of
        both.
    """
    labels = np.full(len(log_odds), -1)
    if 0 in log_odds.shape:
        return labels, np.ones(len(log_odds))
    gain = np.maximum(log_odds, 0.0)
    rows, columns = linear_sum_assignment(-gain)
    weights = np.exp(np.minimum(log_odds, 50.0))
    alternatives = 1.0 + weights.sum(axis=1, keepdims=True) + weights.sum(axis=0) - weights
    share = weights / alternatives
    matched = gain[rows, columns] > 0.0
    labels[rows[matched]] = columns[matched]
    confidence = 1.0 - (weights / (1.0 + weights.sum(axis=1, keepdims=True))).sum(axis=1)
    confidence[rows[matched]] = share[rows[matched], columns[matched]]
    return labels, confidence


def _stray_log_density(stray_density: float) -> float:
    """Log density of strays, less the constant of a normal density."""
    return float(np.log(stray_density * (2.0 * np.pi) ** 1.5))
