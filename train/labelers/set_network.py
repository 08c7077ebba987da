"""The default network: gated messages between points, from the distances between them alone.

Its input is the pairwise distances, so rotating, moving or mirroring the cloud changes nothing: one network
labels left and right hands. Messages are weighted by sigmoid gates of distance and of both ends (no softmax
over points, unlike self-attention), so they add up evidence and can count neighbors. Two outputs are trained
together: the label, or ghost, of each point; and the point, or none, of each label.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from train.config import SetLabelerConfig
from train.data.batches import WHOLE, Batch, Weights
from train.matching.assignment import IMPOSSIBLE, SINKHORN
from train.matching.pose_prior import PosePrior


class LabelScores(NamedTuple):
    """Log-probabilities of both outputs."""

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
        """What labelings are checked against; learned after training."""
        width, bumps = config.width, config.num_distances
        self.register_buffer("centers", torch.linspace(0.0, config.reach, bumps), persistent=False)
        self.embed = nn.Sequential(nn.Linear(bumps + 1, width), nn.SiLU(), nn.Linear(width, width))
        self.rounds = nn.ModuleList(MessageRound(width, config.gates, bumps) for _ in range(config.depth))
        self.norm = nn.LayerNorm(width)
        self.to_scores = nn.Linear(width, config.num_labels + 1)
        self.to_occluded = nn.Sequential(
            nn.Linear(width, width), nn.SiLU(), nn.Linear(width, config.num_labels)
        )

    def forward(self, points: Float[Tensor, "B N 3"], present: Bool[Tensor, "B N"]) -> LabelScores:
        """Score clouds [m], padded where not `present`."""
        batch, count, _ = points.shape
        distances = (points[:, :, None] - points[:, None]).square().sum(-1).add(1e-12).sqrt()  # (B, N, N)
        spacing = self.config.reach / (self.config.num_distances - 1)
        offsets = distances[:, None] - self.centers[:, None, None]
        bumps = torch.exp(offsets.square() * (-0.5 / spacing**2))  # (B, K, N, N)
        there = present[..., None].to(points.dtype)  # (B, N, 1)
        profile = (bumps @ there[:, None])[..., 0].transpose(1, 2)  # (B, N, K)
        about_one = there.sum(1, keepdim=True) / 20.0
        features = self.embed(torch.cat([profile, about_one.expand(-1, count, 1)], dim=-1))  # (B, N, W)
        bumps = bumps.reshape(batch, self.config.num_distances, count * count)
        for message_round in self.rounds:
            features = message_round(features, bumps, there)
        features = self.norm(features)
        scores = self.to_scores(features)
        pooled = (features * there).sum(1) / 20.0
        by_label = scores[..., :-1].masked_fill(~present[..., None], -1e4).transpose(1, 2)  # (B, M, N)
        occluded = self.to_occluded(pooled)[..., None]
        return LabelScores(
            torch.log_softmax(scores, dim=-1),
            torch.log_softmax(torch.cat([by_label, occluded], dim=-1), dim=-1),
        )

    def numpy_weights(self) -> dict[str, np.ndarray]:
        """The weights by name, in the network's own memory."""
        return {name: value.detach().numpy() for name, value in self.state_dict().items()}


class PairedScores(nn.Module):
    """A network with two more outputs, for exported files: what its labels are assigned by.

    They are as `train.matching.assignment` makes them of the scores: the probabilities of pairs of a point
    and a label, ghosts last (B, N, M+1); and what each label costs each point, and each point as a ghost
    (B, N, M+N).
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
        alone = torch.where(numbers[:, None] == numbers, -logs[..., labels:], IMPOSSIBLE)
        return point_scores, label_scores, pairs, torch.cat([costs, alone], -1)


class MessageRound(nn.Module):
    """One round: sum gated messages from all points, then transform the sums."""

    def __init__(self, width: int, gates: int, bumps: int) -> None:
        super().__init__()
        self.gates = gates
        self.norm = nn.LayerNorm(width)
        self.values = nn.Linear(width, width)
        self.ends = nn.Linear(width, 2 * gates)
        self.distance_gate = nn.Linear(bumps, gates)
        self.mix = nn.Linear(width, width)
        # The weights on disk name these modules.
        self.think = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width)
        )

    def forward(
        self,
        features: Float[Tensor, "B N W"],
        bumps: Float[Tensor, "B K N*N"],
        there: Float[Tensor, "B N 1"],
    ) -> Float[Tensor, "B N W"]:
        """Features after one exchange; `there` is 0 for padding, which sends no message."""
        batch, count, width = features.shape
        normed = self.norm(features)
        receiver, sender = self.ends(normed).transpose(1, 2).chunk(2, dim=1)  # (B, G, N) each
        # Gates before points: the large arrays of pairs are then laid out as bmm expects them.
        near = torch.bmm(self.distance_gate.weight.expand(batch, -1, -1), bumps).view(batch, -1, count, count)
        biased = receiver + self.distance_gate.bias[:, None]
        gate = torch.sigmoid(near + biased[..., None] + sender[:, :, None])  # (B, G, N, N)
        values = (self.values(normed) * there).view(batch, count, self.gates, -1).transpose(1, 2)
        received = (gate @ values).transpose(1, 2).reshape(batch, count, width) / 5.0
        features = features + self.mix(received)
        update: Tensor = self.think(features)
        return features + update


def labeling_loss(scores: LabelScores, truth: Tensor, present: Tensor, *, weights: Weights = WHOLE) -> Tensor:
    """Cross-entropy of both outputs.

    Args:
        scores: From `SetLabeler`.
        truth: Label of each point (B, N), -1 for a ghost; padding is ignored.
        present: Which points are there (B, N).
        weights: Of the two, where the clouds are a part of a batch.
    """
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


def set_loss(network: nn.Module, batch: Batch, device: torch.device) -> Tensor:
    """Loss of one batch, see `labeling_loss`."""
    cloud = batch.cloud
    points = torch.from_numpy(cloud.points.astype(np.float32)).to(device)
    present, truth = torch.from_numpy(cloud.present).to(device), torch.from_numpy(cloud.truth).to(device)
    return labeling_loss(network(points, present), truth, present, weights=batch.weights)
