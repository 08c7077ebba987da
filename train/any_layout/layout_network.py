"""The network of the labeler for any layout: points are compared with what is known of a layout's markers.

Both are graphs whose edges are distances: those between the points of a cloud, and the distribution of those
between two markers over many people and poses. Rounds of messages (`train.labelers.set_network`) describe
points and markers; then they are compared, and each round of comparing knows the last one's matches: whom a
point's likely marker expects at which distance, and whether somebody is there (a mean-field step of graph
matching). So a layout that was never trained on is labeled from its distances alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from train.labelers.set_network import LabelScores, MessageRound, labeling_loss

_USUAL: Final = 20.0  # points of a cloud
_RAREST: Final = 1e-3  # share of poses that a distance counts as having at least
_EARLY: Final = 0.3  # weight of the loss of each comparison before the last
_IMPOSSIBLE: Final = -1e4


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
    """Ways in which a distance counts for two pairs of a point and a marker."""
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
        self,
        points: Float[Tensor, "B N 3"],
        present: Bool[Tensor, "B N"],
        layouts: Float[Tensor, "G M M K"],
    ) -> list[LabelScores]:
        """Scores after each comparison, the best last.

        Args:
            points: Clouds [m], padded where not `present`; those of one layout follow each other.
            layouts: Mean of `distance_features` over the poses of each layout; G divides B.
        """
        graphs = _Graphs.of(points, present, layouts, self.config)
        there = graphs.there
        around = torch.cat(
            [graphs.near.mul(there[:, None]).sum(2), (there.sum(1, keepdim=True) / _USUAL).expand_as(there)],
            -1,
        )
        size = layouts.new_full((*layouts.shape[:2], 1), layouts.shape[1] / _USUAL)
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
    """Distances of clouds and layouts in the forms in which the network reads them."""

    near: Float[Tensor, "B N N K"]
    flat_near: Float[Tensor, "B K N*N"]
    shares: Float[Tensor, "B K*N N"]
    """Share of each basis function in the distance to every other point."""
    there: Float[Tensor, "B N 1"]
    pairs: Float[Tensor, "G M M 2K"]
    """Distributions of the distances between two markers, and their logarithms."""
    flat_layouts: Float[Tensor, "G 2K M*M"]

    @classmethod
    def of(cls, points: Tensor, present: Tensor, layouts: Tensor, config: LayoutNetworkConfig) -> _Graphs:
        batch, count = present.shape
        bumps = config.num_distances
        near, there = distance_features(points, config), present[..., None].to(points.dtype)
        others = there[:, None] * (1.0 - torch.eye(count))[None, :, :, None]
        shares = near / near.sum(-1, keepdim=True).clamp_min(1e-3) * others
        pairs = torch.cat([layouts, torch.log(layouts + _RAREST) / 3.0 + 1.0], -1)
        return cls(
            near,
            near.permute(0, 3, 1, 2).reshape(batch, bumps, -1),
            shares.permute(0, 3, 1, 2).reshape(batch, bumps * count, count),
            there,
            pairs,
            pairs.permute(0, 3, 1, 2).flatten(2),
        )


class _Matches(NamedTuple):
    """A comparison of points and markers."""

    scores: Float[Tensor, "B N M"]
    log: LabelScores
    soft: Float[Tensor, "B N M"]
    """How likely each pair is, for both of its ends."""
    points_sure: Float[Tensor, "B N 2"]
    """Probability that a point is a ghost, and of its likeliest marker."""
    markers_sure: Float[Tensor, "B M 2"]
    """Probability that a marker is occluded, and of its likeliest point."""


class Comparison(nn.Module):
    """Compares the features of points and markers; either may have no partner."""

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
        """The matches, with what is known beside the features themselves."""
        left = self.of_points(self.norm_points(of_points))
        right = self.of_markers(self.norm_markers(of_markers))
        scores = left @ right.transpose(1, 2) / math.sqrt(left.shape[-1])
        if evidence is not None:
            scores = scores + evidence
        by_label = scores.masked_fill(~present[..., None], _IMPOSSIBLE).transpose(1, 2)
        points = torch.log_softmax(torch.cat([scores, self.ghost(of_points)], -1), -1)
        labels = torch.log_softmax(torch.cat([by_label, self.occluded(of_markers)], -1), -1)
        soft = torch.exp(0.5 * (points[..., :-1] + labels[..., :-1].transpose(1, 2))) * present[..., None]
        points_sure = torch.cat([points[..., -1:].exp(), soft.amax(2)[..., None]], -1)
        markers_sure = torch.cat([labels[..., -1:].exp(), soft.amax(1)[..., None]], -1)
        return _Matches(scores, LabelScores(points, labels), soft, points_sure, markers_sure)


class MatchExchange(nn.Module):
    """Tells points and markers of their matches, and how well each pair agrees with all others."""

    def __init__(self, config: LayoutNetworkConfig) -> None:
        super().__init__()
        width, bumps, heads = config.width, config.num_distances, config.heads
        self.norm_points, self.norm_markers = nn.LayerNorm(width), nn.LayerNorm(width)
        self.to_points, self.to_markers = nn.Linear(width + 2, width), nn.Linear(width + 2, width)
        self.agreement = nn.Linear(2 * bumps, bumps * heads)
        nn.init.zeros_(self.agreement.bias)
        nn.init.normal_(self.agreement.weight, std=0.01)
        with torch.no_grad():  # begin with the log-likelihood of a distance
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
        """How well the distances from a point fit those from a marker, where the others are matched."""
        batch, count, num_markers = soft.shape
        groups, heads = len(graphs.pairs), len(self.weights)
        bumps = graphs.pairs.shape[-1] // 2
        seen = (graphs.shares @ soft).view(batch, bumps, count, num_markers)  # who is how far from each point
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
    """Loss of all comparisons, see `train.labelers.set_network.labeling_loss`."""
    losses = torch.stack([labeling_loss(scores, truth, present) for scores in found])
    return losses[-1] + _EARLY * losses[:-1].sum()
