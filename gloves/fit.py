"""A hand in its glove: the type shared by users' hands, simulated, tracked and drawn ones."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from gloves.attachment import Attachment, attach_markers
from gloves.layout import MarkerLayout, load_layout
from gloves.optics.visibility import visible_cameras
from handsim.errors import ArgumentError
from handsim.hand.model import HandModel, load_model
from handsim.hand.shape import NUM_QPOS, HandShape, Side
from handsim.space.rig import CameraRig
from handsim.space.transforms import MIRROR


@dataclass(frozen=True, slots=True, eq=False)
class GloveFit:
    """One hand and the glove on it."""

    model: HandModel
    """The hand."""
    attachment: Attachment
    """The glove's markers on this hand."""

    @property
    def side(self) -> Side:
        """Which hand this is."""
        return self.model.shape.side

    @property
    def shape(self) -> HandShape:
        """The hand's measures."""
        return self.model.shape

    @property
    def layout(self) -> MarkerLayout:
        """The glove's markers."""
        return self.attachment.layout

    def with_side(self, side: Side) -> GloveFit:
        """The same hand in its glove on the other (or the same) arm."""
        if side == self.side:
            return self
        worn = self.attachment
        mirrored = dataclasses.replace(worn, points=worn.points @ MIRROR, normals=worn.normals @ MIRROR)
        return GloveFit(HandModel(self.shape.with_side(side)), mirrored)

    def markers(
        self, qpos: Float[np.ndarray, "T 27"]
    ) -> tuple[Float[np.ndarray, "T M 3"], Float[np.ndarray, "T M 3"]]:
        """Marker centers [m] and outward unit directions in the world, for poses of this hand.

        Args:
            qpos: Wrist position [m], wrist orientation (wxyz), joint angles [rad].

        Raises:
            ArgumentError: `qpos` is not (T, 27) or not finite.
        """
        return self.attachment.markers(self.model, self.model.forward_kinematics(qpos))

    def visible(self, qpos: Float[np.ndarray, "T 27"], rig: CameraRig) -> Bool[np.ndarray, "T M C"]:
        """Which cameras see each marker: in view, facing, and not occluded by the hand itself.

        Args:
            qpos: Poses of this hand, wrist position [m] in the world of the rig.
            rig: The cameras.
        """
        bones, capsules = self.model.forward_kinematics(qpos), self.model.capsules
        markers, normals = self.attachment.markers(self.model, bones)
        return visible_cameras(markers, normals, rig, capsules.posed(bones), capsules.radii)


@dataclass(frozen=True, slots=True, eq=False)
class GlovedHand:
    """A hand in its glove, in motion.

    Raises:
        ArgumentError: `qpos` is not (T, 27).
    """

    fit: GloveFit
    qpos: Float[np.ndarray, "T 27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]; NaN in frames without a pose."""

    def __post_init__(self) -> None:
        if self.qpos.ndim != 2 or self.qpos.shape[1] != NUM_QPOS:
            raise ArgumentError(f"qpos has shape {self.qpos.shape}, expected (T, {NUM_QPOS})")

    @property
    def side(self) -> Side:
        """Which hand this is."""
        return self.fit.side

    @property
    def shape(self) -> HandShape:
        """The hand's measures."""
        return self.fit.shape

    @property
    def layout(self) -> MarkerLayout:
        """The glove's markers."""
        return self.fit.layout


def attach(layout: MarkerLayout | str | Path, model: HandModel | HandShape | str) -> GloveFit:
    """Put a glove on a hand as designed.

    Args:
        layout: The glove's markers, or the name or path of a layout.
        model: The hand, its shape, or one of the sizes XS, S, M, L, XL.

    Returns:
        The hand in its glove; `GloveFit.markers` gives marker centers (T, M, 3) [m] of poses.

    Raises:
        ArgumentError: An argument is none of these.
        LayoutError: There is no such layout, or a marker meets no skin; the message names the marker.
    """
    worn_by = load_model(model)
    return GloveFit(worn_by, attach_markers(load_layout(layout), worn_by))


def nominal_fit(layout: MarkerLayout | str | Path, size: str, side: Side) -> GloveFit:
    """A hand of one of the five sizes, with its glove put on as designed.

    Args:
        size: XS, S, M, L or XL: 0.165 to 0.210 [m] of hand length.

    Raises:
        ArgumentError: There is no such size or side.
        LayoutError: A marker meets no skin, and the message names it; or the glove is for the other hand.
    """
    worn, model = load_layout(layout), HandModel.named(size, side=side)
    worn.check_side(side)
    return attach(worn, model)


def nearest_markers(fit: GloveFit) -> tuple[str, str, float]:
    """The two markers that are nearest on the flat hand, and the distance of their centers [m]."""
    points = fit.attachment.points
    distances = np.linalg.norm(points[:, None] - points, axis=-1)
    np.fill_diagonal(distances, np.inf)
    first, second = divmod(int(distances.argmin()), len(points))
    return fit.layout.names[first], fit.layout.names[second], float(distances[first, second])
