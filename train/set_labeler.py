"""The default labeler: gated messages between points, from nothing but the distances between them.

The cloud enters as pairwise distances, so turning, moving or mirroring it changes nothing: one network labels
left and right hands. Messages are weighted by sigmoid gates of distance and of both ends (no softmax over
points, unlike self-attention), so they add up evidence and can count neighbours. Two readings are trained
together: which label, or ghost, a point is; and which point, or none, a label has.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from train.config import SetLabelerConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class LabelScores(NamedTuple):
    """Log-probabilities of both readings."""

    points: Float[Tensor, "B N M+1"]
    """Each point: its label, or ghost (last)."""
    labels: Float[Tensor, "B M N+1"]
    """Each label: its point, or occluded (last)."""


class SetLabeler(nn.Module):
    """Scores of every point against every label, for clouds of any size."""

    centres: Tensor

    def __init__(self, config: SetLabelerConfig) -> None:
        super().__init__()
        self.config = config
        width, bumps = config.width, config.num_distances
        self.register_buffer("centres", torch.linspace(0.0, config.reach, bumps), persistent=False)
        self.embed = nn.Sequential(nn.Linear(bumps + 1, width), nn.SiLU(), nn.Linear(width, width))
        self.rounds = nn.ModuleList(MessageRound(width, config.gates, bumps) for _ in range(config.depth))
        self.norm = nn.LayerNorm(width)
        self.to_scores = nn.Linear(width, config.num_labels + 1)
        self.to_occluded = nn.Sequential(
            nn.Linear(width, width), nn.SiLU(), nn.Linear(width, config.num_labels)
        )

    def forward(self, points: Float[Tensor, "B N 3"], present: Bool[Tensor, "B N"]) -> LabelScores:
        """Score clouds [m], padded where not `present`."""
        distances = (points[:, :, None] - points[:, None]).square().sum(-1).add(1e-12).sqrt()  # (B, N, N)
        spacing = self.config.reach / (self.config.num_distances - 1)
        bumps = torch.exp(-0.5 * ((distances[..., None] - self.centres) / spacing).square())  # (B, N, N, K)
        pairs = (present[:, :, None] & present[:, None]).to(points.dtype)
        count = present.sum(1).to(points.dtype)[:, None, None] / 20.0  # (B, 1, 1), about 1
        profile = (bumps * pairs[..., None]).sum(2)
        features = self.embed(
            torch.cat([profile, count.expand(-1, profile.shape[1], 1)], dim=-1)
        )  # (B, N, W)
        for message_round in self.rounds:
            features = message_round(features, bumps, pairs)
        features = self.norm(features)
        scores = self.to_scores(features)
        pooled = (features * present[..., None]).sum(1) / 20.0
        by_label = scores[..., :-1].masked_fill(~present[..., None], -1e4).transpose(1, 2)  # (B, M, N)
        occluded = self.to_occluded(pooled)[..., None]
        return LabelScores(
            torch.log_softmax(scores, dim=-1),
            torch.log_softmax(torch.cat([by_label, occluded], dim=-1), dim=-1),
        )


class MessageRound(nn.Module):
    """One round: gather gated messages from all points, then think about them."""

    def __init__(self, width: int, gates: int, bumps: int) -> None:
        super().__init__()
        self.gates = gates
        self.norm = nn.LayerNorm(width)
        self.values = nn.Linear(width, width)
        self.ends = nn.Linear(width, 2 * gates)
        self.distance_gate = nn.Linear(bumps, gates)
        self.mix = nn.Linear(width, width)
        self.think = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.SiLU(), nn.Linear(2 * width, width)
        )

    def forward(
        self,
        features: Float[Tensor, "B N W"],
        bumps: Float[Tensor, "B N N K"],
        pairs: Float[Tensor, "B N N"],
    ) -> Float[Tensor, "B N W"]:
        """Features after one exchange; `pairs` is 0 where either point is padding."""
        batch, count, width = features.shape
        normed = self.norm(features)
        receiver, sender = self.ends(normed).chunk(2, dim=-1)  # (B, N, G) each
        gate = torch.sigmoid(self.distance_gate(bumps) + receiver[:, :, None] + sender[:, None])
        gate = (gate * pairs[..., None]).permute(0, 3, 1, 2)  # (B, G, N, N)
        values = self.values(normed).view(batch, count, self.gates, -1).transpose(1, 2)  # (B, G, N, W/G)
        gathered = (gate @ values).transpose(1, 2).reshape(batch, count, width) / 5.0
        features = features + self.mix(gathered)
        thought: Tensor = self.think(features)
        return features + thought


def labeling_loss(scores: LabelScores, truth: Tensor, present: Tensor) -> Tensor:
    """Cross-entropy of both readings.

    Args:
        scores: From `SetLabeler`.
        truth: Label of each point (B, N), -1 for a ghost; what padding holds does not matter.
        present: Which points are there (B, N).
    """
    num_labels = scores.points.shape[-1] - 1
    of_point = torch.where(truth < 0, num_labels, truth)
    point_loss = -scores.points.gather(-1, of_point[..., None])[..., 0][present].mean()
    batch, count = truth.shape
    of_label = truth.new_full((batch, num_labels + 1), count)
    places = torch.arange(count).expand(batch, -1).to(truth.device)
    known = torch.where(present, of_point, num_labels)
    of_label = of_label.scatter(1, known, places)[:, :num_labels]
    label_loss = -scores.labels.gather(-1, of_label[..., None]).mean()
    return point_loss + label_loss
