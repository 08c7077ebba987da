"""Networks of the labelers in torch: how each is built and trained, and how it becomes a labeler.

docs/labeling.md describes the default network. Its messages between points are weighted by sigmoid gates, not
by a softmax over points as in self-attention, so they add up evidence and can count neighbors.

The network for any layout describes points and markers by such messages, based on distances between the
points of a cloud and on distributions of the distance between two markers over many people and poses. It then
compares points and markers in rounds. Each round uses the matches of the last one: it compares distances from
a point to other matched points with those from a marker (a mean-field step of graph matching). So a layout
that was never trained on is labeled by its distances alone.
"""

from __future__ import annotations

import copy
import functools
import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.typing import NDArray
from torch import Tensor, nn

from train.data.batches import WHOLE, Batch, Part, Weights, draw_batch
from train.data.shards import MappedRows
from train.labelers.cnn_labeler import CNNLabeler, MeanHand
from train.labelers.cnn_network import DeepLabelCNN, cnn_loss
from train.labelers.matching import EXCLUDED_COST, SINKHORN
from train.labelers.pose_prior import PosePrior
from train.labelers.protocol import Labeler, torch_threads
from train.labelers.set_inference import MESSAGES, TrainedSetLabeler
from train.settings import CNNConfig, NetworkConfig, SetLabelerConfig, TrainSettings, batch_recipe

_USUAL_POINTS: Final = 20.0  # divisor of the number of points in a cloud
_MIN_SHARE: Final = 1e-3  # added to shares of poses, so that logarithms are finite
_EARLY_WEIGHT: Final = 0.3  # weight of the loss of all comparisons but the last
_PADDING_SCORE: Final = -1e4  # score of padding

_MEAN_HAND_FRAMES: Final = 20_000


class LabelScores(NamedTuple):
    """Log-probabilities of both outputs of a network."""

    points: Float[Tensor, "B N M+1"]
    """Each point: its label, or ghost (last)."""
    labels: Float[Tensor, "B M N+1"]
    """Each label: its point, or occluded (last)."""


class SetLabeler(nn.Module):
    """Scores of every point against every label, for clouds of any size."""

    centers: Tensor

    def __init__(self, config: SetLabelerConfig) -> None:
        super().__init__()
        self.config = config
        self.prior: PosePrior | None = None
        """Prior of hands that verifies labelings; learned after training."""
        width, bumps = config.width, config.num_distances
        self.register_buffer("centers", torch.linspace(0.0, config.reach, bumps), persistent=False)
        self.embed = _embedding(bumps, width)
        self.rounds = nn.ModuleList(MessageRound(width, config.gates, bumps) for _ in range(config.depth))
        self.norm = nn.LayerNorm(width)
        self.to_scores = nn.Linear(width, config.num_labels + 1)
        self.to_occluded = nn.Sequential(
            nn.Linear(width, width), nn.SiLU(), nn.Linear(width, config.num_labels)
        )

    def forward(self, points: Float[Tensor, "B N 3"], present: Bool[Tensor, "B N"]) -> LabelScores:
        """Score clouds [m], which are padded where not `present`."""
        batch, count, _ = points.shape
        distances = (points[:, :, None] - points[:, None]).square().sum(-1).add(1e-12).sqrt()  # (B, N, N)
        spacing = self.config.reach / (self.config.num_distances - 1)
        offsets = distances[:, None] - self.centers[:, None, None]
        bumps = torch.exp(offsets.square() * (-0.5 / spacing**2))  # (B, K, N, N)
        there = present[..., None].to(points.dtype)  # (B, N, 1)
        profile = (bumps @ there[:, None])[..., 0].transpose(1, 2)  # (B, N, K)
        about_one = there.sum(1, keepdim=True) / _USUAL_POINTS
        features = self.embed(torch.cat([profile, about_one.expand(-1, count, 1)], dim=-1))  # (B, N, W)
        bumps = bumps.reshape(batch, self.config.num_distances, count * count)
        for message_round in self.rounds:
            features = message_round(features, bumps, there)
        features = self.norm(features)
        scores = self.to_scores(features)
        pooled = (features * there).sum(1) / _USUAL_POINTS
        by_point = scores[..., :-1].masked_fill(~present[..., None], _PADDING_SCORE)
        by_label = by_point.transpose(1, 2)  # (B, M, N)
        occluded = self.to_occluded(pooled)[..., None]
        return LabelScores(
            torch.log_softmax(scores, dim=-1),
            torch.log_softmax(torch.cat([by_label, occluded], dim=-1), dim=-1),
        )

    def numpy_weights(self) -> dict[str, np.ndarray]:
        """Weights by name, without a copy."""
        return {name: value.detach().numpy() for name, value in self.state_dict().items()}


class PairedScores(nn.Module):
    """A network with two additional outputs of `train.labelers.matching`, for exported files.

    They are the probabilities of pairs of point and label, ghosts last (B, N, M+1), and the costs of pairs
    and of points as ghosts (B, N, M+N).
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(
        self, points: Float[Tensor, "B N 3"], present: Bool[Tensor, "B N"]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Scores of clouds [m], probabilities of pairs, and costs."""
        point_scores, label_scores = self.network(points, present)
        by_point, by_label, labels = point_scores.double(), label_scores.double(), label_scores.shape[1]
        weight, least = SINKHORN["score_weight"], SINKHORN["least_probability"]
        both = by_point[..., :labels] + by_label[..., :-1].transpose(1, 2)
        pairs = torch.exp(weight * torch.cat([both, 2.0 * by_point[..., labels:]], -1)) + least
        pairs = pairs * present[..., None]
        hidden = torch.exp(2.0 * weight * by_label[..., -1:].transpose(1, 2)) + least
        for _ in range(int(SINKHORN["sinkhorn_rounds"])):
            total = pairs[..., :labels].sum(1, keepdim=True) + hidden
            pairs = torch.cat([pairs[..., :labels] / total, pairs[..., labels:]], -1)
            pairs, hidden = pairs / pairs.sum(-1, keepdim=True).clamp_min(least), hidden / total
        logs = torch.log(pairs.clamp_min(least))
        costs = torch.log(hidden.clamp_min(least)) - 2.0 * logs[..., :labels]
        numbers = torch.arange(points.shape[1], device=points.device)
        alone = torch.where(numbers[:, None] == numbers, -logs[..., labels:], EXCLUDED_COST)
        return point_scores, label_scores, pairs, torch.cat([costs, alone], -1)


class MessageRound(nn.Module):
    """One round of messages: sum gated messages from all points, then transform the sums."""

    def __init__(self, width: int, gates: int, bumps: int) -> None:
        super().__init__()
        self.gates = gates
        self.norm = nn.LayerNorm(width)
        self.values = nn.Linear(width, width)
        self.ends = nn.Linear(width, 2 * gates)
        self.distance_gate = nn.Linear(bumps, gates)
        self.mix = nn.Linear(width, width)
        # The weights on disk use this name.
        self.think = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width)
        )

    def forward(
        self, features: Float[Tensor, "B N W"], bumps: Float[Tensor, "B K N*N"], there: Float[Tensor, "B N 1"]
    ) -> Float[Tensor, "B N W"]:
        """Features after one exchange; `there` is 0 for padding, which sends no message."""
        batch, count, width = features.shape
        normed = self.norm(features)
        receiver, sender = self.ends(normed).transpose(1, 2).chunk(2, dim=1)  # (B, G, N) each
        # Gates precede points, because bmm expects the large arrays of pairs in this order.
        near = torch.bmm(self.distance_gate.weight.expand(batch, -1, -1), bumps).view(batch, -1, count, count)
        biased = receiver + self.distance_gate.bias[:, None]
        gate = torch.sigmoid(near + biased[..., None] + sender[:, :, None])  # (B, G, N, N)
        values = (self.values(normed) * there).view(batch, count, self.gates, -1).transpose(1, 2)
        received = (gate @ values).transpose(1, 2).reshape(batch, count, width) / float(MESSAGES)
        features = features + self.mix(received)
        update: Tensor = self.think(features)
        return features + update


def labeling_loss(scores: LabelScores, truth: Tensor, present: Tensor, *, weights: Weights = WHOLE) -> Tensor:
    """Cross-entropy of both outputs; `truth` (B, N) is the label of each present point, -1 a ghost."""
    num_labels = scores.points.shape[-1] - 1
    of_point = torch.where(truth < 0, num_labels, truth)
    point_loss = -scores.points.gather(-1, of_point[..., None])[..., 0][present].mean()
    batch, count = truth.shape
    of_label = truth.new_full((batch, num_labels + 1), count)
    indices = torch.arange(count).expand(batch, -1).to(truth.device)
    known = torch.where(present, of_point, num_labels)
    of_label = of_label.scatter(1, known, indices)[:, :num_labels]
    label_loss = -scores.labels.gather(-1, of_label[..., None]).mean()
    return weights.points * point_loss + weights.clouds * label_loss


@dataclass(frozen=True, slots=True)
class LayoutNetworkConfig:
    """Size of the network for any layout."""

    width: int = 64
    """Channels of a point and of a marker."""
    gates: int = 16
    """Groups of message channels."""
    first_rounds: int = 2
    """Rounds of messages before the first comparison."""
    match_rounds: int = 4
    """Rounds between comparisons."""
    heads: int = 2
    """Number of ways to weight the agreement of distances."""
    num_distances: int = 24
    """Gaussian basis functions that encode a distance."""
    reach: float = 0.24
    """Largest distance [m] with a basis function of its own."""


def distance_features(
    points: Float[Tensor, "B N 3"], config: LayoutNetworkConfig
) -> Float[Tensor, "B N N K"]:
    """Gaussian basis functions of the distances between points [m]."""
    distances = (points[:, :, None] - points[:, None]).square().sum(-1).add(1e-12).sqrt()
    centers = torch.linspace(0.0, config.reach, config.num_distances)
    spacing = config.reach / (config.num_distances - 1)
    return torch.exp((distances[..., None] - centers).square() * (-0.5 / spacing**2))


class LayoutNetwork(nn.Module):
    """Scores of every point of a cloud against every marker of a layout."""

    def __init__(self, config: LayoutNetworkConfig) -> None:
        super().__init__()
        self.config = config
        width, gates, bumps = config.width, config.gates, config.num_distances
        rounds = config.first_rounds + config.match_rounds
        self.embed_points, self.embed_markers = _embedding(bumps, width), _embedding(bumps, width)
        self.point_rounds = nn.ModuleList(MessageRound(width, gates, bumps) for _ in range(rounds))
        self.marker_rounds = nn.ModuleList(MessageRound(width, gates, 2 * bumps) for _ in range(rounds))
        self.comparisons = nn.ModuleList(Comparison(width) for _ in range(config.match_rounds + 1))
        self.exchanges = nn.ModuleList(MatchExchange(config) for _ in range(config.match_rounds))

    def forward(
        self, points: Float[Tensor, "B N 3"], present: Bool[Tensor, "B N"], layouts: Float[Tensor, "G M M K"]
    ) -> list[LabelScores]:
        """Scores after each comparison, the best last.

        Clouds [m] of one layout are contiguous; G, the number of layouts, divides their number. A layout is
        the mean of `distance_features` over its poses.
        """
        graphs = _Graphs.of(points, present, layouts, self.config)
        there = graphs.there
        around = torch.cat(
            [
                graphs.near.mul(there[:, None]).sum(2),
                (there.sum(1, keepdim=True) / _USUAL_POINTS).expand_as(there),
            ],
            -1,
        )
        size = layouts.new_full((*layouts.shape[:2], 1), layouts.shape[1] / _USUAL_POINTS)
        of_points = self.embed_points(around)
        of_markers = self.embed_markers(torch.cat([layouts.sum(2), size], -1))
        for number in range(self.config.first_rounds):
            of_points = self.point_rounds[number](of_points, graphs.flat_near, there)
            of_markers = self.marker_rounds[number](of_markers, graphs.flat_layouts, torch.ones(1, 1, 1))
        each = len(points) // len(layouts)
        of_markers = of_markers.repeat_interleave(each, 0)
        flat_layouts = graphs.flat_layouts.repeat_interleave(each, 0)
        matches = self.comparisons[0](of_points, of_markers, present, None)
        found = [matches.log]
        for number in range(self.config.match_rounds):
            exchange, later = self.exchanges[number], self.config.first_rounds + number
            of_points, of_markers, evidence = exchange(of_points, of_markers, matches, graphs)
            of_points = self.point_rounds[later](of_points, graphs.flat_near, there)
            of_markers = self.marker_rounds[later](of_markers, flat_layouts, torch.ones(1, 1, 1))
            matches = self.comparisons[number + 1](of_points, of_markers, present, evidence)
            found.append(matches.log)
        return found


class _Graphs(NamedTuple):
    """Distances of clouds and layouts in the memory orders that the network needs."""

    near: Float[Tensor, "B N N K"]
    flat_near: Float[Tensor, "B K N*N"]
    shares: Float[Tensor, "B K*N N"]
    """Share of each basis function in the distance to every other point."""
    there: Float[Tensor, "B N 1"]
    pairs: Float[Tensor, "G M M 2K"]
    """Distributions of the distance between two markers, and their scaled logarithms."""
    flat_layouts: Float[Tensor, "G 2K M*M"]

    @classmethod
    def of(cls, points: Tensor, present: Tensor, layouts: Tensor, config: LayoutNetworkConfig) -> _Graphs:
        """The distances of clouds (B, N, 3) [m] and of layouts (G, M, M, K)."""
        batch, count = present.shape
        bumps = config.num_distances
        near, there = distance_features(points, config), present[..., None].to(points.dtype)
        others = there[:, None] * (1.0 - torch.eye(count))[None, :, :, None]
        shares = near / near.sum(-1, keepdim=True).clamp_min(1e-3) * others
        pairs = torch.cat([layouts, torch.log(layouts + _MIN_SHARE) / 3.0 + 1.0], -1)
        return cls(
            near,
            near.permute(0, 3, 1, 2).reshape(batch, bumps, -1),
            shares.permute(0, 3, 1, 2).reshape(batch, bumps * count, count),
            there,
            pairs,
            pairs.permute(0, 3, 1, 2).flatten(2),
        )


class _Matches(NamedTuple):
    """Result of one comparison of points and markers."""

    scores: Float[Tensor, "B N M"]
    log: LabelScores
    soft: Float[Tensor, "B N M"]
    """Geometric mean of both probabilities of a pair."""
    points_sure: Float[Tensor, "B N 2"]
    """Probability that a point is a ghost, and that of its likeliest marker."""
    markers_sure: Float[Tensor, "B M 2"]
    """Probability that a marker is occluded, and that of its likeliest point."""


class Comparison(nn.Module):
    """Compares the features of points and markers; ghosts and occluded markers have no partner."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm_points, self.norm_markers = nn.LayerNorm(width), nn.LayerNorm(width)
        self.of_points, self.of_markers = nn.Linear(width, width), nn.Linear(width, width)
        self.ghost, self.occluded = nn.Linear(width, 1), nn.Linear(width, 1)

    def forward(
        self,
        of_points: Float[Tensor, "B N W"],
        of_markers: Float[Tensor, "B M W"],
        present: Bool[Tensor, "B N"],
        evidence: Float[Tensor, "B N M"] | None,
    ) -> _Matches:
        """Matches from features and, after the first comparison, further evidence."""
        left = self.of_points(self.norm_points(of_points))
        right = self.of_markers(self.norm_markers(of_markers))
        scores = left @ right.transpose(1, 2) / math.sqrt(left.shape[-1])
        if evidence is not None:
            scores = scores + evidence
        by_label = scores.masked_fill(~present[..., None], _PADDING_SCORE).transpose(1, 2)
        points = torch.log_softmax(torch.cat([scores, self.ghost(of_points)], -1), -1)
        labels = torch.log_softmax(torch.cat([by_label, self.occluded(of_markers)], -1), -1)
        soft = torch.exp(0.5 * (points[..., :-1] + labels[..., :-1].transpose(1, 2))) * present[..., None]
        points_sure = torch.cat([points[..., -1:].exp(), soft.amax(2)[..., None]], -1)
        markers_sure = torch.cat([labels[..., -1:].exp(), soft.amax(1)[..., None]], -1)
        return _Matches(scores, LabelScores(points, labels), soft, points_sure, markers_sure)


class MatchExchange(nn.Module):
    """Passes features between matched points and markers, and compares each pair with all others."""

    def __init__(self, config: LayoutNetworkConfig) -> None:
        super().__init__()
        width, bumps, heads = config.width, config.num_distances, config.heads
        self.norm_points, self.norm_markers = nn.LayerNorm(width), nn.LayerNorm(width)
        self.to_points, self.to_markers = nn.Linear(width + 2, width), nn.Linear(width + 2, width)
        self.agreement = nn.Linear(2 * bumps, bumps * heads)
        nn.init.zeros_(self.agreement.bias)
        nn.init.normal_(self.agreement.weight, std=0.01)
        with torch.no_grad():  # Start with the log-likelihood of a distance.
            for head in range(heads):
                rows = slice(head * bumps, (head + 1) * bumps)
                self.agreement.weight[rows, bumps:] += torch.eye(bumps) * (0.3 if head else 1.0)
        self.weights = nn.Parameter(torch.full((heads,), 0.1))
        self.kept = nn.Parameter(torch.tensor(0.5))

    def forward(
        self,
        of_points: Float[Tensor, "B N W"],
        of_markers: Float[Tensor, "B M W"],
        matches: _Matches,
        graphs: _Graphs,
    ) -> tuple[Float[Tensor, "B N W"], Float[Tensor, "B M W"], Float[Tensor, "B N M"]]:
        """New features, and the evidence for each pair."""
        soft = matches.soft
        heard = soft @ self.norm_markers(of_markers)
        points = of_points + self.to_points(torch.cat([heard, matches.points_sure], -1))
        heard = soft.transpose(1, 2) @ self.norm_points(points)
        markers = of_markers + self.to_markers(torch.cat([heard, matches.markers_sure], -1))
        return points, markers, self._agreement(soft, graphs) + self.kept * matches.scores

    def _agreement(self, soft: Float[Tensor, "B N M"], graphs: _Graphs) -> Float[Tensor, "B N M"]:
        """Agreement of the distances from a point to matched points with those from a marker."""
        batch, count, num_markers = soft.shape
        groups, heads = len(graphs.pairs), len(self.weights)
        bumps = graphs.pairs.shape[-1] // 2
        seen = (graphs.shares @ soft).view(batch, bumps, count, num_markers)  # markers at each distance
        seen = seen.permute(0, 2, 1, 3).reshape(groups, -1, bumps * num_markers)
        other = (1.0 - torch.eye(num_markers))[None, :, :, None]
        fits = (self.agreement(graphs.pairs) * other).view(groups, num_markers, num_markers, heads, bumps)
        fits = (fits * self.weights[:, None]).sum(3)  # (G, M, M', K)
        fits = fits.permute(0, 3, 2, 1).reshape(groups, bumps * num_markers, num_markers)
        agreement: Tensor = (seen @ fits).view(batch, count, num_markers)
        return agreement


def _embedding(bumps: int, width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(bumps + 1, width), nn.SiLU(), nn.Linear(width, width))


def layout_loss(found: list[LabelScores], truth: Tensor, present: Tensor) -> Tensor:
    """Loss of all comparisons, see `labeling_loss`."""
    losses = torch.stack([labeling_loss(scores, truth, present) for scores in found])
    return losses[-1] + _EARLY_WEIGHT * losses[:-1].sum()


def new_network(config: NetworkConfig) -> nn.Module:
    """An untrained network with these settings."""
    if isinstance(config, CNNConfig):
        network = DeepLabelCNN(config)
        return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload, no-any-return]
    return SetLabeler(config)


def prepare_network(network: nn.Module, rows: NDArray[np.void] | MappedRows) -> None:
    """Give an untrained network of the paper's kind the mean hand of a training set."""
    if isinstance(network, DeepLabelCNN):
        rng = np.random.default_rng(0)
        config = TrainSettings(batch=_MEAN_HAND_FRAMES, rig_share=0.0, anisotropy=0.0)
        batch = draw_batch(rows, batch_recipe(config, network.config.num_labels), rng=rng)
        hand = MeanHand.of_clouds(batch.markers, batch.cloud.points, batch.cloud.present)
        network.mean_hand.set(hand)


def batch_loss(
    config: TrainSettings,
    network: nn.Module,
    batch: Batch,
    device: torch.device,
    *,
    rng: np.random.Generator,
    part: Part,
) -> torch.Tensor:
    """Loss of a part of a batch, a scalar; its mean over all parts is the loss of the batch.

    Random draws are made for the whole batch, so that a cloud does not depend on the number of parts.
    """
    if config.labeler == "cnn":
        return cnn_loss(network, batch, device, config, rng=rng, part=part)
    (points, present, truth), _, weights = part.of(batch)
    known = torch.from_numpy(present).to(device)
    scores = network(torch.from_numpy(points.astype(np.float32)).to(device), known)
    return labeling_loss(scores, torch.from_numpy(truth).to(device), known, weights=weights)


def cnn_labeler(network: DeepLabelCNN, marker_names: tuple[str, ...]) -> CNNLabeler:
    """The paper's network with trained weights as a labeler; its first batch copies it to the GPU, if any.

    TF32 is off, so that labels differ from the CPU's only in near ties.
    """
    network.eval()

    @functools.cache
    def placed() -> tuple[nn.Module, torch.device]:
        device, here = batch_device(), next(network.parameters()).device
        return network if device == here else copy.deepcopy(network).to(device), device

    @torch.inference_mode()
    def positions(images: NDArray[np.float32]) -> NDArray[np.float32]:
        own, device = placed()
        with torch_threads(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            return np.asarray(own(torch.from_numpy(images).to(device)).cpu().numpy())

    return CNNLabeler(positions, network.mean_hand.get(), network.config, marker_names)


def labeler_of(network: nn.Module, marker_names: tuple[str, ...]) -> Labeler:
    """A trained network as a labeler."""
    if isinstance(network, DeepLabelCNN):
        return cnn_labeler(network, marker_names)
    assert isinstance(network, SetLabeler)
    return TrainedSetLabeler(network.config, network.numpy_weights(), network.prior, marker_names)


def batch_device() -> torch.device:
    """Device on which batches are labeled."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")
