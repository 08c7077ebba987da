"""The two networks of the hand detector: where hands are in a picture, and where keypoints are in a hand."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

from handsim.hand.shape import NUM_KEYPOINTS


def convolution(inside: int, outside: int, stride: int = 1) -> list[nn.Module]:
    """A convolution, followed by a batch normalization and a ReLU."""
    return [nn.Conv2d(inside, outside, 3, stride, 1, bias=False), nn.BatchNorm2d(outside), nn.ReLU()]


class Residual(nn.Module):
    """Two convolutions beside the way past them (He et al. 2016)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            *convolution(width, width), nn.Conv2d(width, width, 3, 1, 1, bias=False), nn.BatchNorm2d(width)
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Features in, features out."""
        return functional.relu(x + self.layers(x))


class Backbone(nn.Module):
    """Features at an eighth of the picture's size, joined with upsampled ones at a thirty-second."""

    def __init__(self, widths: tuple[int, int, int, int]) -> None:
        super().__init__()
        a, b, c, d = widths
        self.fine = nn.Sequential(
            *(nn.Conv2d(3, a, 8, 4, 2, bias=False), nn.BatchNorm2d(a), nn.ReLU(), Residual(a)),
            *(*convolution(a, b, 2), Residual(b), Residual(b)),
        )
        self.coarse = nn.Sequential(
            *(*convolution(b, c, 2), Residual(c), Residual(c)),
            *(*convolution(c, d, 2), Residual(d), Residual(d)),
        )
        self.narrow = nn.Conv2d(d, b, 1)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Features of each cell, and the coarsest ones."""
        fine = self.fine(x)
        coarse = self.coarse(fine)
        wide = functional.interpolate(self.narrow(coarse), scale_factor=4.0, mode="bilinear")
        return torch.cat([fine, wide], dim=1), coarse


class FinderNetwork(nn.Module):
    """Cells (B, 4, S/8, S/8) of pictures (B, 3, S, S).

    Log-odds of a hand's center in the cell, the center from the cell's middle [cells], and the logarithm of
    the hand's longer side [cells].
    """

    def __init__(self) -> None:
        super().__init__()
        self.backbone = Backbone((16, 32, 48, 64))
        last = nn.Conv2d(48, 4, 1)
        self.head = nn.Sequential(*convolution(64, 48), last)
        assert last.bias is not None
        nn.init.constant_(last.bias[:1], -4.0)  # most cells have no hand

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Pictures in, cells out."""
        return torch.as_tensor(self.head(self.backbone(x)[0]))


class KeypointNetwork(nn.Module):
    """Maps of keypoints (B, 21, 16, 16), and log-odds of a hand and of a palm before the camera (B, 2)."""

    def __init__(self) -> None:
        super().__init__()
        self.backbone = Backbone((32, 64, 96, 128))
        self.head = nn.Sequential(*convolution(128, 64), Residual(64), nn.Conv2d(64, NUM_KEYPOINTS, 1))
        self.presence_head = nn.Sequential(nn.Flatten(), nn.Linear(16 * 128, 64), nn.ReLU(), nn.Linear(64, 2))

    def keep_keypoints(self) -> None:
        """Train only the head of presence and palm: without this, keypoints got 3 to 5 % worse."""
        self.backbone.requires_grad_(False)
        self.head.requires_grad_(False)

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Squares in, maps and log-odds out."""
        features, coarse = self.backbone(x)
        return self.head(features), self.presence_head(coarse)
