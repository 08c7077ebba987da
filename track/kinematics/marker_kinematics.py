"""Markers of a posed hand and their least squares, compiled, with nothing but arrays inside.

Everything happens in the wrist's frame: the markers that are looked for are carried there, so a fit does not
know where the hand is. The unknowns of a step are the twenty hinges, then how the wrist moves and turns, both
along its own axes; hinges come first because the factor of the normal matrix then keeps its zeros between
digits.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numba
import numpy as np

from gloves.fit import GloveFit
from handsim.hand.topology import BONES, NUM_BONES, NUM_JOINTS

if TYPE_CHECKING:
    from jaxtyping import Float, Int

NUM_UNKNOWNS: Final = NUM_JOINTS + 6
FAST: Final = {"contract", "reassoc", "nsz"}  # what lets sums go several at a time; NaN keeps its meaning
_SHIFT: Final = NUM_JOINTS
_TURN: Final = NUM_JOINTS + 3


class HandArrays(NamedTuple):
    """What a kernel needs to know of a hand and its glove."""

    offsets: Float[np.ndarray, "L 3"]
    rotations: Float[np.ndarray, "L 3 3"]
    axes: Float[np.ndarray, "J 3"]
    ranges: Float[np.ndarray, "J 2"]
    bones: Int[np.ndarray, "M 4"]
    """The bones that carry each marker, strongest first; -1 where there is no further one."""
    shares: Float[np.ndarray, "M 4"]
    places: Float[np.ndarray, "M 4 3"]
    """Where each marker sits in the frames of its bones [m], times the bone's share."""
    digits: Int[np.ndarray, "M"]
    """Digit of the bone that carries most of each marker; -1 for the palm."""
    reach: Int[np.ndarray, "M 2"]
    """First hinge that may move each marker, and the one after the last."""
    starts: Int[np.ndarray, "26"]
    """First unknown that each row of the normal matrix shares a marker with."""


class Workspace(NamedTuple):
    """A pose's bones and markers in the wrist's frame, and the equations of its next step."""

    rotations: Float[np.ndarray, "L 3 3"]
    origins: Float[np.ndarray, "L 3"]
    axes: Float[np.ndarray, "J 3"]
    carried: Float[np.ndarray, "M 4 3"]
    """Each bone's share of a marker's place."""
    markers: Float[np.ndarray, "M 3"]
    misses: Float[np.ndarray, "M 3"]
    """Marker of the hand minus marker looked for; NaN where it is missing."""
    slopes: Float[np.ndarray, "M 3 26"]
    """Derivatives of the markers by the unknowns."""
    normal: Float[np.ndarray, "26 26"]
    """Upper triangle; nothing between digits that no marker joins."""
    gradient: Float[np.ndarray, "26"]
    factor: Float[np.ndarray, "26 26"]
    step: Float[np.ndarray, "26"]


def hand_arrays(fit: GloveFit) -> HandArrays:
    """The arrays of a hand and its glove."""
    model, attachment = fit.model, fit.attachment
    skeleton = model.skeleton
    inverse = np.linalg.inv(model.rest_transforms)[attachment.bone_indices]
    local = np.einsum("mkij,mj->mki", inverse[..., :3, :3], attachment.points) + inverse[..., :3, 3]
    order = np.argsort(-attachment.bone_weights, axis=1, kind="stable")
    bones, shares = (
        np.take_along_axis(values, order, axis=1)
        for values in (attachment.bone_indices, attachment.bone_weights)
    )
    places = np.take_along_axis(local, order[..., None], axis=1) * shares[..., None]
    digits = np.array([bone.digit for bone in BONES])
    carriers = np.where(shares > 0.0, digits[bones], -1)
    reach = np.zeros((len(bones), 2), dtype=np.int64)
    starts = np.zeros(NUM_UNKNOWNS, dtype=np.int64)
    starts[:NUM_JOINTS] = np.arange(NUM_JOINTS) // 4 * 4
    for marker, row in enumerate(carriers):
        moving = row[row >= 0]
        if len(moving):
            first, last = 4 * moving.min(), 4 * moving.max() + 4
            reach[marker] = first, last
            starts[first:last] = np.minimum(starts[first:last], first)
    return HandArrays(
        np.array(skeleton.offsets, order="C"),
        np.array(skeleton.rotations, order="C"),
        np.array(skeleton.axes, order="C"),
        np.array(skeleton.ranges, order="C"),
        np.where(shares > 0.0, bones, -1),
        shares,
        np.array(places, order="C"),
        digits[bones[:, 0]],
        reach,
        starts,
    )


@numba.njit(cache=True)  # type: ignore[untyped-decorator]
def workspace(num_markers: Any) -> Any:
    """Room for one frame's arithmetic."""
    rotations, slopes = np.zeros((NUM_BONES, 3, 3)), np.zeros((num_markers, 3, NUM_UNKNOWNS))
    for i in range(3):
        rotations[0, i, i] = 1.0
        slopes[:, i, _SHIFT + i] = 1.0
    return Workspace(
        rotations,
        np.zeros((NUM_BONES, 3)),
        np.empty((NUM_JOINTS, 3)),
        np.zeros((num_markers, 4, 3)),
        np.empty((num_markers, 3)),
        np.empty((num_markers, 3)),
        slopes,
        np.empty((NUM_UNKNOWNS, NUM_UNKNOWNS)),
        np.empty(NUM_UNKNOWNS),
        np.empty((NUM_UNKNOWNS, NUM_UNKNOWNS)),
        np.empty(NUM_UNKNOWNS),
    )


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def place_markers(hand: Any, angles: Any, work: Any) -> None:
    """Bones, hinge axes and markers of a pose in the wrist's frame."""
    for digit in range(NUM_JOINTS // 4):
        place_digit(hand, digit, angles[4 * digit : 4 * digit + 4], work)
    for marker in range(len(hand.bones)):
        place_marker(hand, marker, work)


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def place_digit(hand: Any, digit: Any, angles: Any, work: Any) -> None:
    """Bones and hinge axes of one digit in the wrist's frame."""
    for place in range(3):
        bone = 1 + 3 * digit + place
        parent = bone - 1 if place > 0 else 0
        turned, own = work.rotations[parent], work.rotations[bone]
        for i in range(3):
            work.origins[bone, i] = work.origins[parent, i]
            for j in range(3):
                work.origins[bone, i] += turned[i, j] * hand.offsets[bone, j]
                own[i, j] = 0.0
                for k in range(3):
                    own[i, j] += turned[i, k] * hand.rotations[bone, k, j]
        for number in range(place + 1 if place > 0 else 0, place + 2):
            hinge = 4 * digit + number
            _turn(own, hand.axes[hinge], angles[number], work.axes[hinge])


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def place_marker(hand: Any, marker: Any, work: Any) -> None:
    """One marker in the wrist's frame, its bones being placed."""
    work.markers[marker] = 0.0
    for slot in range(4):
        bone = hand.bones[marker, slot]
        if bone < 0:
            break
        own, place = work.rotations[bone], hand.places[marker, slot]
        for i in range(3):
            carried = hand.shares[marker, slot] * work.origins[bone, i]
            carried += own[i, 0] * place[0] + own[i, 1] * place[1] + own[i, 2] * place[2]
            work.carried[marker, slot, i] = carried
            work.markers[marker, i] += carried


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def _turn(own: Any, axis: Any, angle: Any, outside: Any) -> None:
    """Turn a bone about an axis of its own, which is also written as the wrist sees it."""
    sine, cosine = np.sin(angle), np.cos(angle)
    x, y, z = axis[0], axis[1], axis[2]
    for i in range(3):
        a, b, c = own[i, 0], own[i, 1], own[i, 2]
        along = a * x + b * y + c * z
        outside[i] = along
        along *= 1.0 - cosine
        own[i, 0] = a * cosine + along * x + (b * z - c * y) * sine
        own[i, 1] = b * cosine + along * y + (c * x - a * z) * sine
        own[i, 2] = c * cosine + along * z + (a * y - b * x) * sine


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def find_slopes(hand: Any, marker: Any, work: Any) -> None:
    """Derivatives of one marker by all unknowns, in the wrist's frame."""
    slopes = work.slopes[marker]
    for digit in range(hand.reach[marker, 0] // 4, hand.reach[marker, 1] // 4):
        x, y, z, share = 0.0, 0.0, 0.0, 0.0
        for place in range(2, -1, -1):  # a hinge moves what hangs on its own bone and on those beyond
            bone = 1 + 3 * digit + place
            for slot in range(4):
                if hand.bones[marker, slot] == bone:
                    x += work.carried[marker, slot, 0]
                    y += work.carried[marker, slot, 1]
                    z += work.carried[marker, slot, 2]
                    share += hand.shares[marker, slot]
            p = x - share * work.origins[bone, 0]
            q = y - share * work.origins[bone, 1]
            r = z - share * work.origins[bone, 2]
            for hinge in range(4 * digit + (place + 1 if place > 0 else 0), 4 * digit + place + 2):
                a, b, c = work.axes[hinge, 0], work.axes[hinge, 1], work.axes[hinge, 2]
                slopes[0, hinge] = b * r - c * q
                slopes[1, hinge] = c * p - a * r
                slopes[2, hinge] = a * q - b * p
    x, y, z = work.markers[marker, 0], work.markers[marker, 1], work.markers[marker, 2]
    slopes[1, _TURN], slopes[2, _TURN] = -z, y
    slopes[0, _TURN + 1], slopes[2, _TURN + 1] = z, -x
    slopes[0, _TURN + 2], slopes[1, _TURN + 2] = -y, x


@numba.njit(cache=True, fastmath=FAST, error_model="numpy")  # type: ignore[untyped-decorator]
def gather(hand: Any, weights: Any, work: Any) -> None:
    """Normal matrix and gradient of the markers' weighted squared misses."""
    normal, gradient = work.normal, work.gradient
    normal[:] = 0.0
    gradient[:] = 0.0
    for marker in range(len(weights)):
        find_slopes(hand, marker, work)
        weight, slopes = weights[marker], work.slopes[marker]
        if weight == 0.0:
            continue
        first, last = hand.reach[marker, 0], hand.reach[marker, 1]
        x, y, z = work.misses[marker, 0], work.misses[marker, 1], work.misses[marker, 2]
        for number in range(last - first + 6):
            row = first + number if number < last - first else _SHIFT + number - (last - first)
            a, b, c = weight * slopes[0, row], weight * slopes[1, row], weight * slopes[2, row]
            gradient[row] += a * x + b * y + c * z
            for column in range(row, last):
                normal[row, column] += a * slopes[0, column] + b * slopes[1, column] + c * slopes[2, column]
            for column in range(_SHIFT, NUM_UNKNOWNS):
                normal[row, column] += a * slopes[0, column] + b * slopes[1, column] + c * slopes[2, column]
