"""How joints shape the skin around them: knuckles and the valleys between them, tendons, balls of the hand.

Linear blend skinning flattens a bent joint, where a hand shows the head of the bone. Each shape is a smooth
hill on the skin at rest, along its normals, whose height follows an angle; heights are those of bones under
thin skin (Gray's Anatomy, surface anatomy of the hand: heads of the metacarpals and phalanges, extensor
tendons, thenar and hypothenar eminences, head of the ulna), chosen by eye.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from handsim.hand.model import HandModel
from handsim.hand.shape import JOINT_NAMES
from handsim.space.transforms import MIRROR
from render.skin.fields import bump, smooth

_REFERENCE: Final = 0.0118  # radius of an average finger at its knuckle, for which the lengths below are [m]
_NEAR: Final = 0.018  # [m] from a thumb's axis that only its own skin is
_FINGERS: Final = ("index", "middle", "ring", "little")


class _Hill(NamedTuple):
    """A shape of the skin."""

    joint: int
    """Whose angle decides the height; -1 for a shape that is always there."""
    start: float
    """Angle without height [deg]."""
    full: float
    """Angle with full height [deg]."""
    heights: NDArray[np.float64]
    """Full height at each vertex (U,) along the normal [m]."""


class Flexion:
    """The shapes of one hand.

    Args:
        rest: Vertices (U, 3) at rest, in the wrist's frame [m].
        normals: Their outward unit normals (U, 3).
        bony: Factor on all heights.
    """

    def __init__(
        self, model: HandModel, rest: NDArray[np.float64], normals: NDArray[np.float64], bony: float
    ) -> None:
        hills = list(_hills(model, rest, normals))
        self._joints = np.array([hill.joint for hill in hills])
        self._start = np.deg2rad([hill.start for hill in hills])
        self._full = np.deg2rad([hill.full for hill in hills])
        heights = bony * np.stack([hill.heights for hill in hills], axis=1)
        self._rows = np.flatnonzero(np.abs(heights).max(axis=1) > 1e-6)
        self._heights, self._normals = heights[self._rows], normals[self._rows]

    def shaped(
        self, rest: Float[np.ndarray, "U 3"], angles: Float[np.ndarray, "20"]
    ) -> Float[np.ndarray, "U 3"]:
        """Vertices at rest as the angles [rad] shape them [m]."""
        angle = np.where(self._joints < 0, self._full, angles[self._joints])
        share = smooth(angle, self._start, self._full)
        shaped: NDArray[np.float64] = rest.copy()
        shaped[self._rows] += (self._heights @ share)[:, None] * self._normals
        return shaped


def _hills(model: HandModel, rest: NDArray[np.float64], normals: NDArray[np.float64]) -> Iterator[_Hill]:
    """All shapes, on the right hand that the hand is a mirror image of."""
    mirror = MIRROR if model.shape.side == "left" else np.eye(3)
    points, outward = rest @ mirror, normals @ mirror
    frames = model.rest_transforms.copy()
    frames[:, :3, :3] = mirror @ frames[:, :3, :3] @ mirror
    frames[:, :3, 3] = frames[:, :3, 3] @ mirror
    skin = _Skin(points, outward, frames, model.shape.radii[1:, 0].mean() / _REFERENCE)
    for number, digit in enumerate(_FINGERS, 1):
        yield from _finger(skin, number, digit, model.shape.radii[number, 0] / _REFERENCE)
    yield from _valleys(skin)
    yield from _thumb(skin)
    yield from _palm(skin)
    yield from _ulna(skin)


class _Skin(NamedTuple):
    """A right hand at rest."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]
    frames: NDArray[np.float64]
    """Transforms of the bones (16, 4, 4)."""
    scale: float
    """Of the hand against the reference."""

    def local(self, bone: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Points (U, 3) [m] in a bone's frame, and how far they face its back, -1 to 1 (U,)."""
        frame = self.frames[bone]
        return (self.points - frame[:3, 3]) @ frame[:3, :3], self.normals @ frame[:3, 2]

    def beside(
        self, start: NDArray[np.float64], end: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How far along a segment of the wrist's x and y [m] points are, 0 to 1, and how far from it [m]."""
        way = end - start
        along = np.clip((self.points[:, :2] - start) @ way / (way @ way), 0.0, 1.0)
        return along, np.linalg.norm(self.points[:, :2] - start - along[:, None] * way, axis=1)

    def knob(
        self, bone: int, height: float, along: float, aside: float, *, at: tuple[float, float] = (0.0, 0.0)
    ) -> NDArray[np.float64]:
        """A hill on the back of a bone, `at` its x and y; `along` and `aside` are its half widths [m]."""
        place, facing = self.local(bone)
        size = self.scale
        hill = bump(place[:, 0] - size * at[0], size * along) * bump(place[:, 1] - size * at[1], size * aside)
        hill *= smooth(facing, -0.1, 0.5) * (place[:, 2] > -0.004)
        result: NDArray[np.float64] = size * height * hill
        return result

    def girth(self, bone: int, height: float, at: float, along: float) -> NDArray[np.float64]:
        """A hill around the thumb but for its back, `at` a place along a bone, of this half width [m]."""
        place, facing = self.local(bone)
        near = np.linalg.norm(place[:, 1:], axis=1) < _NEAR * self.scale
        hill = near * bump(place[:, 0] - at, self.scale * along) * smooth(-facing, -0.8, -0.2)
        result: NDArray[np.float64] = self.scale * height * hill
        return result

    def ball(
        self, center: tuple[float, float], height: float, width: float, *, back: bool
    ) -> NDArray[np.float64]:
        """A hill on the back or the palm, around a place of the wrist's frame [m]."""
        size = self.scale
        distance = np.linalg.norm(self.points[:, :2] - size * np.array(center), axis=1)
        facing = self.normals[:, 2] if back else -self.normals[:, 2]
        result: NDArray[np.float64] = size * height * bump(distance, size * width) * smooth(facing, 0.0, 0.6)
        return result


def _joint(name: str) -> int:
    return JOINT_NAMES.index(name)


def _finger(skin: _Skin, number: int, digit: str, wide: float) -> Iterator[_Hill]:
    """Three knuckles of a finger, its tendon, and the pad that its bending pushes out."""
    first = 1 + 3 * number
    bent, straight = _joint(f"{digit}_MCP_flexion"), (15.0, -22.0)
    yield _Hill(bent, 5.0, 85.0, skin.knob(first, 0.0042 * wide, 0.0075, 0.0062, at=(-0.001, 0.0)))
    yield _Hill(_joint(f"{digit}_PIP_flexion"), 5.0, 95.0, skin.knob(first + 1, 0.0019, 0.0058, 0.0056))
    yield _Hill(_joint(f"{digit}_DIP_flexion"), 5.0, 75.0, skin.knob(first + 2, 0.0012, 0.0042, 0.0050))
    knuckle = skin.frames[first, :2, 3]
    root = np.array([0.1, 0.35]) * knuckle  # tendons meet at the wrist
    along, aside = skin.beside(root, knuckle)
    ridge = 0.0014 * smooth(along, 0.15, 0.75) * bump(aside, 0.0030) * smooth(skin.normals[:, 2], 0.2, 0.7)
    yield _Hill(bent, *straight, skin.scale * ridge)
    place, facing = skin.local(first)
    middle = 0.5 * np.linalg.norm(skin.frames[first + 1, :3, 3] - skin.frames[first, :3, 3])
    shaft = skin.knob(first, -0.0018 * wide, 0.0095, 0.0075, at=(float(middle) / skin.scale, 0.0))
    yield _Hill(bent, 10.0, 85.0, shaft)
    neck = skin.knob(first, -0.0014 * wide, 0.0090, 0.0085, at=(-0.021, 0.0))
    yield _Hill(bent, 10.0, 85.0, neck)
    pad = 0.0018 * bump(place[:, 0] - middle, 0.009) * bump(place[:, 1], 0.007) * smooth(-facing, 0.1, 0.7)
    yield _Hill(_joint(f"{digit}_PIP_flexion"), 20.0, 100.0, skin.scale * pad * (place[:, 2] < 0.004))


def _valleys(skin: _Skin) -> Iterator[_Hill]:
    """Hollows between the knuckles of a fist, down to where the fingers part."""
    for number in (1, 2, 3):
        first, second = 1 + 3 * number, 4 + 3 * number
        here = 0.5 * (skin.frames[first, :2, 3] + skin.frames[second, :2, 3])
        parted = here + 0.45 * (0.5 * (skin.frames[first + 1, :2, 3] + skin.frames[second + 1, :2, 3]) - here)
        along, aside = skin.beside(here, parted)
        hollow = -0.0042 * bump(aside, skin.scale * 0.0048) * smooth(skin.normals[:, 2], 0.0, 0.6)
        hollow *= 1.0 - 0.4 * along
        yield _Hill(_joint(f"{_FINGERS[number]}_MCP_flexion"), 10.0, 85.0, skin.scale * hollow)


def _thumb(skin: _Skin) -> Iterator[_Hill]:
    """Its knuckles, its waist and pad, and the muscle that lies between it and the index when they close."""
    yield _Hill(_joint("thumb_MCP_flexion"), 0.0, 55.0, skin.knob(2, 0.0022, 0.0070, 0.0068))
    yield _Hill(_joint("thumb_IP_flexion"), 5.0, 70.0, skin.knob(3, 0.0020, 0.0060, 0.0065))
    middle = 0.5 * float(np.linalg.norm(skin.frames[3, :3, 3] - skin.frames[2, :3, 3]))
    yield _Hill(-1, 0.0, 1.0, skin.girth(2, -0.0013, middle, 0.0085))
    yield _Hill(-1, 0.0, 1.0, skin.girth(3, 0.0013, 0.0125 * skin.scale, 0.0075))
    muscle = skin.ball((0.062, 0.026), 0.0030, 0.0130, back=True)
    yield _Hill(_joint("thumb_CMC_abduction"), 15.0, -25.0, muscle)


def _palm(skin: _Skin) -> Iterator[_Hill]:
    """The balls of thumb and little finger, and the hollow between them."""
    for name, start, full, center, height, width in (
        ("thumb_CMC_flexion", -10.0, 35.0, (0.040, 0.020), 0.0035, 0.0150),
        ("little_MCP_flexion", 10.0, 80.0, (0.035, -0.028), 0.0028, 0.0140),
        ("ring_MCP_flexion", 10.0, 80.0, (0.055, -0.004), -0.0025, 0.0120),
    ):
        yield _Hill(_joint(name), start, full, skin.ball(center, height, width, back=False))


def _ulna(skin: _Skin) -> Iterator[_Hill]:
    """Its head, on the little finger's side of the wrist's back."""
    yield _Hill(-1, 0.0, 1.0, skin.ball((-0.016, -0.021), 0.0040, 0.0085, back=True))
