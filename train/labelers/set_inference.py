"""The trained set labeler for single clouds, compiled and without torch.

With so few points torch spends most time on calls. Operations have the order of
`train.labelers.networks`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int32
from numpy.typing import NDArray

from handsim._process import with_own_numerics
from handsim.kernels import kernel
from train.labelers.matching import match_scores
from train.labelers.pose_prior import PosePrior
from train.labelers.protocol import Labeling, check_clouds, check_output
from train.settings import SetLabelerConfig

Floats = NDArray[np.float32]
Weights = Mapping[str, Floats]
"""Weights of the network by their names in `train.labelers.networks`."""

_EPSILON: Final = np.float32(1e-5)  # that of torch's LayerNorm
_NEAREST: Final = np.float32(1e-12)  # [m^2] added to squared distances
_COUNT: Final = np.float32(20.0)  # divisor of sums over the points of a cloud
MESSAGES: Final = np.float32(5.0)  # divisor of sums over the senders of messages
# exp(x) = 2^n exp(r) with r = x - n log(2), and exp(r) a polynomial: accurate to two units in the last place.
_LIMIT: Final = np.float32(80.0)  # Beyond it the logistic function is 0 or 1 in single precision.
_LOG2E: Final = np.float32(1.4426950408889634)
_LN2_HIGH, _LN2_LOW = np.float32(0.693359375), np.float32(-2.12194440e-4)
_HALF, _ONE, _ZERO = np.float32(0.5), np.float32(1.0), np.float32(0.0)
# Minimax coefficients of Cephes' expf (Moshier).
_P5, _P4, _P3 = np.float32(1.9875691500e-4), np.float32(1.3981999507e-3), np.float32(8.3334519073e-3)
_P2, _P1 = np.float32(4.1665795894e-2), np.float32(1.6666665459e-1)


class _Norm(NamedTuple):
    """Weights of the layer normalization in each of the D rounds of messages."""

    weight: Float32[np.ndarray, "D W"]
    bias: Float32[np.ndarray, "D W"]


class _Linear(NamedTuple):
    """Linear layers of D rounds, with transposed weights."""

    weight: Float32[np.ndarray, "D I O"]
    bias: Float32[np.ndarray, "D O"]


class _Rounds(NamedTuple):
    """The rounds of messages."""

    norm: _Norm
    ends: _Linear
    distance_gate: Float32[np.ndarray, "D G K"]
    values: _Linear
    mix: _Linear
    think_norm: _Norm
    think: _Linear
    think_again: _Linear


class _Ends(NamedTuple):
    """Layers before and after the rounds, with D = 1."""

    embed: _Linear
    embed_again: _Linear
    norm: _Norm
    to_scores: _Linear
    to_occluded: _Linear
    to_occluded_again: _Linear


class TrainedSetLabeler:
    """The set labeler with a prior of hands and its own copy of weights, see `weight_shapes`."""

    def __init__(
        self,
        config: SetLabelerConfig,
        weights: Weights,
        prior: PosePrior | None,
        marker_names: tuple[str, ...],
    ) -> None:
        self.prior = prior
        self.marker_names = marker_names
        self._sharpness = np.float32(-0.5 * ((config.num_distances - 1) / config.reach) ** 2)
        self._centers = _centers(config)
        weights = {name: np.asarray(one, dtype=np.float32) for name, one in weights.items()}
        rounds = [f"rounds.{number}." for number in range(config.depth)]
        ends = _linear(weights, rounds, "ends")
        ends.bias[:, : config.gates] += _stacked(weights, rounds, "distance_gate.bias")
        self._rounds = _Rounds(
            _norm(weights, rounds, "norm"),
            ends,
            _stacked(weights, rounds, "distance_gate.weight"),
            _linear(weights, rounds, "values"),
            _linear(weights, rounds, "mix"),
            _norm(weights, rounds, "think.0"),
            _linear(weights, rounds, "think.1"),
            _linear(weights, rounds, "think.3"),
        )
        self._ends = _Ends(
            _linear(weights, [""], "embed.0"),
            _linear(weights, [""], "embed.2"),
            _norm(weights, [""], "norm"),
            _linear(weights, [""], "to_scores"),
            _linear(weights, [""], "to_occluded.0"),
            _linear(weights, [""], "to_occluded.2"),
        )

    @with_own_numerics
    def label_frames(self, frames: Sequence[Float[np.ndarray, "N 3"]]) -> list[Labeling]:
        """Label the points [m] of every frame, see `train.labelers.protocol.Labeler`."""
        return [self._label(cloud) for cloud in check_clouds(frames)]

    def _label(self, cloud: NDArray[np.float64]) -> Labeling:
        """Label the points of one cloud [m]."""
        if not len(cloud):
            return Labeling(np.zeros(0, dtype=np.int64), np.zeros(0))
        by_point, by_label = self.scores(cloud)
        check_output(by_label)
        return Labeling(*match_scores(cloud, by_point, by_label, self.prior))

    def scores(
        self, points: Float[np.ndarray, "N 3"]
    ) -> tuple[Float32[np.ndarray, "N M+1"], Float32[np.ndarray, "M N+1"]]:
        """Log-probabilities of points and labels, as in `train.labelers.networks.LabelScores`."""
        cloud = np.ascontiguousarray(points, dtype=np.float64)
        return _score(cloud, self._centers, self._sharpness, self._rounds, self._ends)


def weight_shapes(config: SetLabelerConfig) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network's weights in torch, where a linear layer is (outputs, inputs)."""
    width, labels = config.width, config.num_labels
    linear = {
        "embed.0": (width, config.num_distances + 1),
        "embed.2": (width, width),
        "to_scores": (labels + 1, width),
        "to_occluded.0": (width, width),
        "to_occluded.2": (labels, width),
    }
    norms = ["norm"]
    for number in range(config.depth):
        one = f"rounds.{number}."
        linear |= {
            f"{one}values": (width, width),
            f"{one}ends": (2 * config.gates, width),
            f"{one}distance_gate": (config.gates, config.num_distances),
            f"{one}mix": (width, width),
            f"{one}think.1": (2 * width, width),
            f"{one}think.3": (width, 2 * width),
        }
        norms += [f"{one}norm", f"{one}think.0"]
    shapes: dict[str, tuple[int, ...]] = {f"{name}.weight": shape for name, shape in linear.items()}
    shapes |= {f"{name}.bias": (outputs,) for name, (outputs, _) in linear.items()}
    return shapes | {f"{name}.{part}": (width,) for name in norms for part in ("weight", "bias")}


def _centers(config: SetLabelerConfig) -> Float32[np.ndarray, "K"]:
    """Centers of the distance bumps [m], computed like torch's linspace: the second half from the end."""
    reach, count = np.float32(config.reach), config.num_distances
    steps = np.arange(count) * np.float64(reach / np.float32(count - 1))
    return np.where(np.arange(count) < count // 2, steps, reach - steps[::-1]).astype(np.float32)


def _linear(weights: Weights, parts: list[str], name: str) -> _Linear:
    """The linear layer of this name in several parts of the network."""
    transposed = np.ascontiguousarray(_stacked(weights, parts, f"{name}.weight").transpose(0, 2, 1))
    return _Linear(transposed, _stacked(weights, parts, f"{name}.bias"))


def _norm(weights: Weights, parts: list[str], name: str) -> _Norm:
    """The layer norm of this name in several parts of the network."""
    return _Norm(_stacked(weights, parts, f"{name}.weight"), _stacked(weights, parts, f"{name}.bias"))


def _stacked(weights: Weights, parts: list[str], name: str) -> Floats:
    return np.stack([weights[f"{part}{name}"] for part in parts])


@kernel
def _score(
    points: Float[np.ndarray, "N 3"],
    centers: Float32[np.ndarray, "K"],
    sharpness: np.float32,
    rounds: _Rounds,
    ends: _Ends,
) -> tuple[Floats, Floats]:
    """Log-probabilities (N, M + 1) of points and (M, N + 1) of labels; `centers` are those of bumps [m]."""
    count, width = len(points), ends.embed.weight.shape[2]
    bits = np.empty(max(len(centers) * count * count, 2 * width * count), dtype=np.int32)
    scale = bits.view(np.float32)
    bumps = _bumps(points, centers, sharpness, bits, scale)
    profile = np.empty((count, len(centers) + 1), dtype=np.float32)
    for k in range(len(centers)):
        for i in range(count):
            total = _ZERO
            for j in range(count):
                total += bumps[k, i * count + j]
            profile[i, k] = total
    profile[:, -1] = np.float32(count) / _COUNT
    hidden = _dense(profile, ends.embed, 0)
    _silu(hidden.ravel(), bits, scale)
    features = _dense(hidden, ends.embed_again, 0)
    for one in range(len(rounds.distance_gate)):
        _exchange(features, bumps, rounds, one, bits, scale)
        hidden = _dense(_layer_norm(features, rounds.think_norm, one), rounds.think, one)
        _silu(hidden.ravel(), bits, scale)
        features += _dense(hidden, rounds.think_again, one)
    features = _layer_norm(features, ends.norm, 0)
    scores = _dense(features, ends.to_scores, 0)
    pooled = np.zeros((1, width), dtype=np.float32)
    for i in range(count):
        pooled[0] += features[i]
    pooled /= _COUNT
    hidden = _dense(pooled, ends.to_occluded, 0)
    _silu(hidden.ravel(), bits, scale)
    occluded = _dense(hidden, ends.to_occluded_again, 0)
    labels = np.empty((scores.shape[1] - 1, count + 1), dtype=np.float32)
    labels[:, :-1], labels[:, -1] = scores[:, :-1].T, occluded[0]
    _log_softmax(scores)
    _log_softmax(labels)
    return scores, labels


@kernel
def _bumps(
    points: Float[np.ndarray, "N 3"],
    centers: Float32[np.ndarray, "K"],
    sharpness: np.float32,
    bits: Int32[np.ndarray, "B"],
    scale: Float32[np.ndarray, "B"],
) -> Floats:
    """Gaussian bumps (K, N * N) of the distances between points around each center, from 0 to 1."""
    count = len(points)
    near = np.empty((count, 3), dtype=np.float32)
    for axis in range(3):
        near[:, axis] = points[:, axis] - points[:, axis].mean()
    distances = np.empty(count * count, dtype=np.float32)
    for i in range(count):
        for j in range(count):
            x, y, z = near[i, 0] - near[j, 0], near[i, 1] - near[j, 1], near[i, 2] - near[j, 2]
            distances[i * count + j] = np.sqrt(x * x + y * y + z * z + _NEAREST)
    bumps = np.empty((len(centers), count * count), dtype=np.float32)
    for k in range(len(centers)):
        for pair in range(count * count):
            off = distances[pair] - centers[k]
            bumps[k, pair] = off * off * sharpness
    flat = bumps.ravel()
    _split_exp(flat, bits, scale)
    for index in range(len(flat)):
        flat[index] *= scale[index]
    return bumps


@kernel
def _exchange(
    features: Float32[np.ndarray, "N W"],
    bumps: Float32[np.ndarray, "K N*N"],
    rounds: _Rounds,
    one: int,
    bits: Int32[np.ndarray, "B"],
    scale: Float32[np.ndarray, "B"],
) -> None:
    """Add the gated messages of a round to the features."""
    count, width, num_gates = len(features), features.shape[1], rounds.distance_gate.shape[1]
    normed = _layer_norm(features, rounds.norm, one)
    ends = _dense(normed, rounds.ends, one)  # receivers, then senders
    gate = np.dot(rounds.distance_gate[one], bumps)
    for g in range(num_gates):  # As bumps are symmetric, receivers may be contiguous.
        for j in range(count):
            for i in range(count):
                gate[g, j * count + i] += ends[i, g] + ends[j, num_gates + g]
    _sigmoid(gate.ravel(), bits, scale)
    values = _dense(normed, rounds.values, one)
    sums, received = np.zeros((width, count), dtype=np.float32), np.empty((count, width), dtype=np.float32)
    for column in range(width):
        g = column * num_gates // width
        for j in range(count):
            value = values[j, column]
            for i in range(count):
                sums[column, i] += gate[g, j * count + i] * value
        for i in range(count):
            received[i, column] = sums[column, i] / MESSAGES
    features += _dense(received, rounds.mix, one)


@kernel
def _dense(values: Float32[np.ndarray, "N I"], layer: _Linear, one: int) -> Floats:
    """A linear layer (N, O)."""
    result: Floats = np.dot(values, layer.weight[one]).astype(np.float32)
    for i in range(len(result)):
        for j in range(result.shape[1]):
            result[i, j] += layer.bias[one, j]
    return result


@kernel
def _layer_norm(values: Float32[np.ndarray, "N W"], norm: _Norm, one: int) -> Floats:
    """A layer norm (N, W)."""
    count, width = values.shape
    result = np.empty((count, width), dtype=np.float32)
    for i in range(count):
        mean, variance = _ZERO, _ZERO
        for j in range(width):
            mean += values[i, j]
        mean /= np.float32(width)
        for j in range(width):
            variance += (values[i, j] - mean) * (values[i, j] - mean)
        factor = _ONE / np.sqrt(variance / np.float32(width) + _EPSILON)
        for j in range(width):
            result[i, j] = (values[i, j] - mean) * factor * norm.weight[one, j] + norm.bias[one, j]
    return result


@kernel
def _split_exp(
    values: Float32[np.ndarray, "L"], bits: Int32[np.ndarray, "B"], scale: Float32[np.ndarray, "B"]
) -> None:
    """Exponential of values as a product: one factor in place, and a power of two in `scale`.

    `scale` and `bits` share memory; values beyond 80 are clipped.
    """
    for index in range(len(values)):
        x = values[index]
        x = x if x < _LIMIT else _LIMIT
        x = x if x > -_LIMIT else -_LIMIT
        whole = np.floor(x * _LOG2E + _HALF)
        r = x - whole * _LN2_HIGH - whole * _LN2_LOW
        p = ((((_P5 * r + _P4) * r + _P3) * r + _P2) * r + _P1) * r + _HALF
        values[index] = p * r * r + r + _ONE
        bits[index] = (np.int32(whole) + np.int32(127)) << np.int32(23)


@kernel
def _sigmoid(
    values: Float32[np.ndarray, "L"], bits: Int32[np.ndarray, "B"], scale: Float32[np.ndarray, "B"]
) -> None:
    """Logistic function in place."""
    for index in range(len(values)):
        values[index] = -values[index]
    _split_exp(values, bits, scale)
    for index in range(len(values)):
        values[index] = _ONE / (_ONE + values[index] * scale[index])


@kernel
def _silu(
    values: Float32[np.ndarray, "L"], bits: Int32[np.ndarray, "B"], scale: Float32[np.ndarray, "B"]
) -> None:
    """Values times their logistic function, in place."""
    gate = values.copy()
    _sigmoid(gate, bits, scale)
    for index in range(len(values)):
        values[index] *= gate[index]


@kernel
def _log_softmax(values: Float32[np.ndarray, "R C"]) -> None:
    """Logarithm of the softmax along the last axis, in place."""
    for row in range(len(values)):
        most = values[row].max()
        total = _ZERO
        for column in range(values.shape[1]):
            total += np.exp(values[row, column] - most)
        off = most + np.log(total)
        for column in range(values.shape[1]):
            values[row, column] -= off
