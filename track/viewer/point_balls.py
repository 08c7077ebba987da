"""Points in the page: balls in the colors of their labels, with names where they are wanted."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np
import trimesh
from jaxtyping import Bool, Float, Int, UInt8

if TYPE_CHECKING:
    from viser import LabelHandle, ViserServer


GHOST_COLOR: Final = (128, 128, 128)
"""Of points without a label."""
_FILLED: Final = 0.45  # size of a marker that was not seen


def label_colors(names: Sequence[str]) -> UInt8[np.ndarray, "K 3"]:
    """A color for each label; markers of one name on two hands ("right:ThumbTip") have the same."""
    bare = [name.rsplit(":", 1)[-1] for name in names]
    order = {name: number for number, name in enumerate(dict.fromkeys(bare))}
    # Hues in the order of the glove, so that neighbors differ little and digits differ much; two brightnesses
    # tell neighbors apart.
    colors = [
        colorsys.hsv_to_rgb(0.92 * order[name] / max(len(order), 1), 1.0, 0.9 if order[name] % 2 else 0.6)
        for name in bare
    ]
    return np.round(255 * np.array(colors).reshape(-1, 3)).astype(np.uint8)


class PointBalls:
    """Up to `most` balls at once, all in one message a frame.

    Args:
        name: Of the node in the scene.
        most: Number of balls.
        radius: Of a ball [m].
    """

    def __init__(
        self, server: ViserServer, name: str, label_names: tuple[str, ...], *, most: int, radius: float
    ) -> None:
        self._server, self._name, self._names = server, name, label_names
        # The last row is that of label -1.
        self._palette = np.concatenate([label_colors(label_names), np.array([GHOST_COLOR], dtype=np.uint8)])
        self._texts: dict[int, LabelHandle] = {}
        self._chosen: frozenset[int] = frozenset()
        ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
        count = max(most, 1)
        self._positions = np.zeros((count, 3), dtype=np.float32)
        self._scales = np.zeros(count, dtype=np.float32)
        self._colors = np.zeros((count, 3), dtype=np.uint8)
        self._points, self._labels = np.empty((0, 3)), np.empty(0, dtype=np.int64)
        self.balls = server.scene.add_batched_meshes_simple(
            name,
            np.asarray(ball.vertices),
            np.asarray(ball.faces),
            batched_wxyzs=np.tile(np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), (count, 1)),
            batched_positions=self._positions,
            batched_scales=self._scales,
            batched_colors=self._colors,
            lod="off",
            cast_shadow=False,
        )
        """All balls; those that are not in use have no size."""

    def show(
        self, points: Float[np.ndarray, "N 3"], labels: Int[np.ndarray, "N"], seen: Bool[np.ndarray, "N"]
    ) -> None:
        """Show these points [m]; those that were not seen are small."""
        count = min(len(points), len(self._positions))
        self._points, self._labels = points[:count], labels[:count]
        positions, scales, colors = self._positions.copy(), np.zeros_like(self._scales), self._colors.copy()
        positions[:count] = self._points
        scales[:count] = np.where(seen[:count], 1.0, _FILLED)
        colors[:count] = self._palette[self._labels]
        if not np.array_equal(positions, self._positions):
            self.balls.batched_positions = self._positions = positions
        if not np.array_equal(scales, self._scales):
            self.balls.batched_scales = self._scales = scales
        if not np.array_equal(colors, self._colors):
            self.balls.batched_colors = self._colors = colors
        self._show_names()

    def name(self, labels: frozenset[int]) -> None:
        """Show the names of these labels, and no others, where their points are."""
        self._chosen = labels
        self._show_names()

    def nearest(self, origin: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> int | None:
        """The index of the shown point that is nearest to a ray; None where there are none."""
        if not len(self._points):
            return None
        unit = direction / np.linalg.norm(direction)
        offsets = self._points - origin
        away = np.linalg.norm(offsets - (offsets @ unit)[:, None] * unit, axis=1)
        return int(away.argmin())

    def label_at(self, index: int) -> int:
        """The label of a shown point."""
        return int(self._labels[index])

    def _show_names(self) -> None:
        places = {int(label): point for label, point in zip(self._labels, self._points, strict=True)}
        for label in self._chosen & places.keys():
            if label not in self._texts:
                self._texts[label] = self._server.scene.add_label(
                    f"{self._name}/names/{label}",
                    self._names[label].rsplit(":", 1)[-1],  # the hand is seen
                    font_screen_scale=0.7,
                    anchor="bottom-left",
                )
            self._texts[label].position = places[label]
        for label, text in self._texts.items():
            shown = label in self._chosen and label in places
            if text.visible != shown:
                text.visible = shown
