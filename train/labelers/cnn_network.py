"""The paper's network: VGG-style, from a depth image to the position of each marker.

Han et al. 2018, Table 1. Its filters are valid (no padding): 52 → 50 → 48, pool 24 → 22 → 20 → 18, pool 9.
The outputs are positions in the image's view frame (`train.labelers.depth_image.ViewFrames`), in the
layout's marker order; labels come from matching them with the points (equation 1).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment
from torch import Tensor, nn
from torch.nn import functional

from train.labelers.matching import GHOST

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
    from numpy.typing import NDArray

REJECT = 0.015
"""Distance beyond which a point is a ghost rather than the marker predicted there [m]; the paper's gate."""


class DeepLabelCNN(nn.Module):
    """Positions of a layout's markers from sparse 52×52 depth images.

    Args:
        num_labels: Markers of the layout.
    """

    def __init__(self, num_labels: int) -> None:
        super().__init__()
        self.num_labels = num_labels
        self.features = nn.Sequential(
            *_filters(1, 64),
            *_filters(64, 64),
            nn.MaxPool2d(2),
            *_filters(64, 128),
            *_filters(128, 128),
            *_filters(128, 128),
            nn.MaxPool2d(2),
        )
        self.positions = nn.Sequential(
            nn.Flatten(),
            nn.Linear(128 * 9 * 9, 2048),
            nn.ReLU(inplace=True),
            nn.Linear(2048, num_labels * 3),
        )

    def forward(self, images: Float[Tensor, "B 1 52 52"]) -> Float[Tensor, "B M 3"]:
        """Marker positions in view units, those of occluded markers too."""
        positions: Tensor = self.positions(self.features(images))
        return positions.view(-1, self.num_labels, 3)


def _filters(channels_in: int, channels_out: int) -> tuple[nn.Module, ...]:
    """Conv + BN + ReLU of Table 1."""
    return nn.Conv2d(channels_in, channels_out, 3), nn.BatchNorm2d(channels_out), nn.ReLU(inplace=True)


def position_loss(
    predicted: Float[Tensor, "B M 3"], targets: Float[Tensor, "B M 3"], present: Bool[Tensor, "B M"]
) -> Tensor:
    """Smooth L1 distance, the mean over coordinates of present markers; 0 where there are none.

    Args:
        predicted: From `DeepLabelCNN`.
        targets: True positions in view units; absent markers are ignored and may be NaN.
        present: Which markers count.
    """
    total = functional.smooth_l1_loss(predicted[present], targets[present], reduction="sum")
    return total / max(1, 3 * int(present.sum()))


def match_positions(
    predicted: Float[np.ndarray, "M 3"], points: Float[np.ndarray, "N 3"], reject: float = REJECT
) -> Int[np.ndarray, "N"]:
    """One-to-one labeling of a cloud with the least total distance.

    The paper's equation 1, with the reject option that its results imply: a point may stay without a label at
    the cost of `reject`, so no point is matched over a larger distance.

    Args:
        predicted: Predicted position of each marker [m].
        points: The cloud in the same frame [m]; NaN rows are missing.
        reject: Cost of a point without a label [m].

    Returns:
        Label of each point, `GHOST` where none.
    """
    count, num_labels = len(points), len(predicted)
    distances = np.linalg.norm(points[:, None] - predicted[None], axis=-1)
    cost = np.full((count, num_labels + count), np.inf)
    cost[:, :num_labels] = np.where(np.isfinite(distances), distances, np.inf)
    cost[np.arange(count), num_labels + np.arange(count)] = reject
    _, columns = linear_sum_assignment(cost)
    labels: NDArray[np.int64] = np.where(columns < num_labels, columns, GHOST)
    return labels
