"""A calibrated user: each hand as it is, over the named size that is nearest to it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from gloves.fit import GloveFit, nominal_fit
from handsim.hand.shape import NUM_QPOS, SIZES
from track.viewer.hand_skin import HandSkin
from track.viewer.point_balls import PointBalls
from track.viewer.stage import set_stage

if TYPE_CHECKING:
    from viser import FrameHandle, GuiCheckboxHandle, GuiEvent, ViserServer

_SPACING: Final = 0.14  # [m] between the middles of two hands
_HEIGHT: Final = 0.06  # [m] above the ground
_BEFORE: Final = (150, 150, 150)


class UserView:
    """Hands of a user's file, flat, side by side; lines lead from the designed markers to the real ones."""

    def __init__(self, server: ViserServer, hands: Sequence[GloveFit]) -> None:
        self.before = [nominal_hand(hand) for hand in hands]
        """The hands of the nearest named sizes, in gloves as designed."""
        self.skins: list[HandSkin] = []
        """Skin of each hand after and before calibration, in turn."""
        gui, scene = server.gui, server.scene
        for node in ("/after", "/before"):
            root = scene.add_frame(node, show_axes=False)
            words = "calibrated hands" if node == "/after" else "hands of the nearest size"
            switch = gui.add_checkbox(words, True)
            switch.on_update(partial(_switch, root))
        corners = []
        for number, (hand, before) in enumerate(zip(hands, self.before, strict=True)):
            shift = np.array([0.0, _SPACING * (number - (len(hands) - 1) / 2), _HEIGHT])
            self._add_hand(server, f"/after/{hand.side}", hand, shift, None)
            self._add_hand(server, f"/before/{hand.side}", before, shift, _BEFORE)
            ends = np.stack([before.attachment.points, hand.attachment.points], axis=1) + shift
            scene.add_line_segments(
                f"/moved/{hand.side}",
                points=ends,
                colors=(200, 60, 50),
                thickness=2.0,
                thickness_units="screen",
            )
            corners.append(hand.model.surface.vertices + shift)
            gui.add_markdown(describe(hand, before))
        set_stage(server, np.concatenate(corners), ground=0.0)

    def _add_hand(
        self,
        server: ViserServer,
        node: str,
        hand: GloveFit,
        shift: np.ndarray,
        color: tuple[int, int, int] | None,
    ) -> None:
        qpos = np.zeros(NUM_QPOS)
        qpos[:3], qpos[3] = shift, 1.0
        skin = HandSkin(server, f"{node}/skin", color=color, opacity=None if color is None else 0.35)
        skin.show(hand.model, qpos)
        self.skins.append(skin)
        count = hand.layout.num_markers
        radius = hand.layout.radius * (1.0 if color is None else 0.5)
        balls = PointBalls(server, f"{node}/markers", hand.layout.names, most=count, radius=radius)
        balls.show(hand.attachment.points + shift, np.arange(count), np.ones(count, dtype=np.bool_))


def _switch(node: FrameHandle, event: GuiEvent[GuiCheckboxHandle]) -> None:
    node.visible = event.target.value


def nominal_hand(hand: GloveFit) -> GloveFit:
    """The hand of the named size whose length is nearest, in the same glove as designed."""
    fits = [nominal_fit(hand.layout, size, hand.side) for size in SIZES]
    return min(fits, key=lambda fit: abs(fit.shape.length - hand.shape.length))


def describe(hand: GloveFit, before: GloveFit) -> str:
    """A hand's measures beside those of the named size, in words."""
    moved = np.linalg.norm(hand.attachment.points - before.attachment.points, axis=1)
    return (
        f"**{hand.side}**: {1e3 * hand.shape.length:.0f} x {1e3 * hand.shape.breadth:.0f} mm, "
        f"nearest size {1e3 * before.shape.length:.0f} x {1e3 * before.shape.breadth:.0f} mm; "
        f"markers differ by {1e3 * np.median(moved):.1f} mm (median), {1e3 * moved.max():.1f} mm at most"
    )
