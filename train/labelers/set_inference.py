"""The set labeler on one cloud in numpy: torch's time for so few points goes to its calls.

Names of weights, and the operations in their order, are those of `train.labelers.set_network`.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float32
from numpy.typing import NDArray

from train.labelers.set_network import SetLabeler

_EPSILON = np.float32(1e-5)  # of torch's LayerNorm


class CloudScorer:
    """Scores of one cloud without padding.

    Args:
        network: Network in evaluation mode; later changes of its weights have no effect.
    """

    def __init__(self, network: SetLabeler) -> None:
        config = network.config
        self._gates = config.gates
        self._centers = network.centers.numpy()[:, None, None]
        self._sharpness = np.float32(-0.5 * ((config.num_distances - 1) / config.reach) ** 2)
        weights = {name: value.detach().numpy() for name, value in network.state_dict().items()}
        self._embed = _Layers(weights, "embed.")
        self._rounds = [_Layers(weights, f"rounds.{number}.") for number in range(config.depth)]
        self._last = _Layers(weights, "")

    def score(
        self, points: Float[np.ndarray, "N 3"]
    ) -> tuple[Float32[np.ndarray, "N M+1"], Float32[np.ndarray, "M N+1"]]:
        """Log-probabilities as in `train.labelers.set_network.LabelScores`.

        Args:
            points: One point or more [m].
        """
        count = len(points)
        near = (points - points.mean(axis=0)).astype(np.float32)
        offsets = near[:, None] - near
        distances = np.sqrt(np.einsum("ijk,ijk->ij", offsets, offsets) + np.float32(1e-12))
        bumps = np.square(distances - self._centers)
        bumps *= self._sharpness
        np.exp(bumps, out=bumps)  # (K, N, N)
        profile = np.empty((count, len(bumps) + 1), dtype=np.float32)
        profile[:, :-1], profile[:, -1] = bumps.sum(axis=2).T, count / 20.0
        features = self._embed.linear("2", _silu(self._embed.linear("0", profile)))
        flat = bumps.reshape(len(bumps), -1)
        for layers in self._rounds:
            features += self._message(layers, features, flat)
            features += self._thought(layers, features)
        features = self._last.norm("norm", features)
        scores = self._last.linear("to_scores", features)
        pooled = features.sum(axis=0) / np.float32(20.0)
        occluded = self._last.linear("to_occluded.2", _silu(self._last.linear("to_occluded.0", pooled)))
        labels = np.concatenate([scores[:, :-1].T, occluded[:, None]], axis=1)
        return _log_softmax(scores), _log_softmax(labels)

    def _message(
        self, layers: _Layers, features: NDArray[np.float32], bumps: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """What the points of features (N, W) tell each other; `bumps` (K, N * N)."""
        count, gates = len(features), self._gates
        normed = layers.norm("norm", features)
        ends = layers.linear("ends", normed).T  # (2 G, N): receivers, then senders
        gate: NDArray[np.float32] = (layers.weight("distance_gate") @ bumps).reshape(gates, count, count)
        gate += (ends[:gates] + layers.bias("distance_gate")[:, None])[..., None]
        gate += ends[gates:, None]
        _sigmoid(gate)
        values = layers.linear("values", normed).reshape(count, gates, -1).transpose(1, 0, 2)
        received: NDArray[np.float32] = (gate @ values).transpose(1, 0, 2).reshape(count, -1)
        received /= np.float32(5.0)
        return layers.linear("mix", received)

    def _thought(self, layers: _Layers, features: NDArray[np.float32]) -> NDArray[np.float32]:
        """What each point makes of its features (N, W)."""
        hidden = layers.linear("think.1", layers.norm("think.0", features))
        return layers.linear("think.3", _silu(hidden))


class _Layers:
    """The linear layers and norms of a part of the network, by their names there."""

    def __init__(self, weights: dict[str, NDArray[np.float32]], prefix: str) -> None:
        own = {name.removeprefix(prefix): value for name, value in weights.items() if name.startswith(prefix)}
        self._weights = {name: np.ascontiguousarray(value) for name, value in own.items()}
        self._transposed = {name: np.ascontiguousarray(value.T) for name, value in own.items()}

    def weight(self, name: str) -> NDArray[np.float32]:
        """A layer's weights (outputs, inputs)."""
        return self._weights[f"{name}.weight"]

    def bias(self, name: str) -> NDArray[np.float32]:
        """A layer's bias (outputs,)."""
        return self._weights[f"{name}.bias"]

    def linear(self, name: str, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """A linear layer of values (..., inputs)."""
        result: NDArray[np.float32] = values @ self._transposed[f"{name}.weight"]
        result += self.bias(name)
        return result

    def norm(self, name: str, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """A layer norm of values (N, W)."""
        centered: NDArray[np.float32] = values - values.mean(axis=1, keepdims=True)
        variance = np.einsum("nw,nw->n", centered, centered)[:, None] / np.float32(values.shape[1])
        centered *= self.weight(name) / np.sqrt(variance + _EPSILON)
        centered += self.bias(name)
        return centered


def _sigmoid(values: NDArray[np.float32]) -> None:
    """The logistic function in place; beyond 80 it is 0 or 1 in single precision."""
    np.clip(values, -80.0, 80.0, out=values)
    np.negative(values, out=values)
    np.exp(values, out=values)
    values += np.float32(1.0)
    np.reciprocal(values, out=values)


def _silu(values: NDArray[np.float32]) -> NDArray[np.float32]:
    gate = values.copy()
    _sigmoid(gate)
    gate *= values
    return gate


def _log_softmax(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Along the last axis."""
    shifted: NDArray[np.float32] = values - values.max(axis=1, keepdims=True)
    shifted -= np.log(np.exp(shifted).sum(axis=1, keepdims=True))
    return shifted
