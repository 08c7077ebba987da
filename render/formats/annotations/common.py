"""What the annotation formats share: masks, run lengths, JSON, and where pixels are counted from.

We count pixels from the picture's corner, so that the first center is at 0.5. OpenCV, and with it FreiHAND,
InterHand2.6M, UmeTrack and COCO's keypoints, count from the first center: `CENTER` is subtracted for them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray

from handsim.errors import HandSimError
from handsim.hand.shape import HandShape, Side
from handsim.space.camera import Camera
from handsim.space.transforms import rotation_quaternions
from render.frames import PARTS_A_HAND, HandTruth, Pictures, RenderedFrame
from render.skin.forearm import FOREARM

CENTER: Final = 0.5
"""Where our count of pixels has the first one's center [px]."""


def shifted_K(camera: Camera) -> NDArray[np.float64]:
    """K for pixels that are counted from the first one's center; a lens is left to its coefficients."""
    K = camera.K.copy()
    K[:2, 2] -= CENTER
    return K


def centered_K(camera: Camera) -> NDArray[np.float64]:
    """`shifted_K` of a pinhole, which alone projects points; other lenses are refused."""
    if camera.lens.kind != "pinhole":
        raise HandSimError(
            f"camera '{camera.name}' has a lens '{camera.lens.kind}', which this format cannot hold; "
            "expected a pinhole camera, or the format webdataset, coco, yolo, exr or png"
        )
    return shifted_K(camera)


def as_sensed(frame: RenderedFrame) -> Pictures:
    """The frame's pictures as its camera has them: the noisy ones where there are any."""
    ideal, noisy = frame.ideal, frame.noisy
    return Pictures(
        rgb=ideal.rgb if noisy.rgb is None else noisy.rgb,
        depth=ideal.depth if noisy.depth is None else noisy.depth,
        normals=ideal.normals,
        parts=ideal.parts,
        instances=ideal.instances,
        markers=ideal.markers,
    )


def is_seen(hand: HandTruth) -> bool:
    """Whether any of the hand is in the picture."""
    return bool(np.isfinite(hand.box).all())


def keypoint_flags(hand: HandTruth, size: tuple[int, int]) -> Int[np.ndarray, "21"]:
    """COCO's flags of keypoints in a picture of this size [px]: 0 outside it, 1 hidden, 2 seen."""
    inside = np.all((hand.keypoints >= 0.0) & (hand.keypoints < size), axis=1)  # never so for NaN
    return np.where(inside, np.where(hand.visible, 2, 1), 0)


def hand_mask(frame: RenderedFrame, hand: int) -> Bool[np.ndarray, "H W"] | None:
    """Mask of one hand of a frame with its markers, without its forearm; None without an id picture."""
    parts, instances = frame.ideal.parts, frame.ideal.instances
    first = 1 + PARTS_A_HAND * hand
    if instances is not None:
        mask: NDArray[np.bool_] = instances == hand + 1
        return mask if parts is None else mask & (parts != first + FOREARM)
    if parts is not None:
        return (parts >= first) & (parts < first + FOREARM)
    return None


def run_lengths(mask: Bool[np.ndarray, "H W"]) -> list[int]:
    """COCO's uncompressed run lengths: of alternating zeros and ones, zeros first, column by column."""
    flat = mask.ravel(order="F")
    changes = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    ends = np.concatenate([[0], changes, [flat.size]])
    counts: list[int] = np.diff(ends).tolist()
    return [0, *counts] if flat[0] else counts


def by_side(frame: RenderedFrame) -> dict[Side, HandTruth]:
    """The frame's hands by their sides."""
    hands = {hand.shape.side: hand for hand in frame.hands}
    if len(hands) < len(frame.hands):
        sides = " and ".join(hand.shape.side for hand in frame.hands)
        raise HandSimError(
            f"frame {frame.number} has hands {sides}; this format holds at most one of each side"
        )
    return hands


def without_colors(name: str) -> HandSimError:
    """The error for a format that needs color pictures."""
    return HandSimError(f"the format {name} needs color pictures; add rgb to the passes")


def rigid_record(transform: Float[np.ndarray, "4 4"]) -> dict[str, list[float]]:
    """A rigid transform as quaternion (wxyz) and translation [m]."""
    return {
        "quaternion_wxyz": rotation_quaternions(transform[None, :3, :3])[0].tolist(),
        "translation_xyz": transform[:3, 3].tolist(),
    }


def shape_record(shape: HandShape) -> dict[str, Any]:
    """A person's hand as JSON; the fields of `HandShape`."""
    fields = {name: getattr(shape, name) for name in HandShape.__dataclass_fields__}
    return {name: _listed(x) if isinstance(x, np.ndarray | np.generic) else x for name, x in fields.items()}


def rounded(values: NDArray[np.floating], decimals: int) -> Any:
    """Numbers as nested lists, short enough to be read."""
    return np.round(np.asarray(values, dtype=np.float64), decimals).tolist()


def to_json(content: Any) -> str:
    """JSON of plain values and arrays; null for NaN, which strict readers refuse."""
    try:
        return json.dumps(content, default=_listed, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError):  # something the quick way has no word for
        return json.dumps(_plain(content), allow_nan=False, separators=(",", ":"))


def _listed(content: Any) -> Any:
    if isinstance(content, np.ndarray | np.generic):
        return content.tolist()
    raise TypeError


def _plain(content: Any) -> Any:
    if isinstance(content, Mapping):
        return {str(key): _plain(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_plain(value) for value in content]
    if isinstance(content, np.ndarray | np.generic):
        return _plain(content.tolist())
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
