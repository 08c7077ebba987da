"""`RenderedFrame`: the pictures of one camera at one time, and their ground truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple, Protocol

import numpy as np
from jaxtyping import Bool, Float, Float16, Float32, Int, UInt8
from numpy.typing import NDArray

from handsim.hand.shape import NUM_BONES, HandShape
from handsim.space.camera import Camera

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Integers = NDArray[np.int64]
Bytes = NDArray[np.uint8]
Flags = NDArray[np.bool_]

PASSES: Final = ("rgb", "depth", "normals", "ids")
"""Kinds of pictures that can be asked for."""
FOREARM: Final = NUM_BONES
"""Number of the forearm among a hand's parts, after those of its bones (`handsim.hand.shape.BONES`)."""
PARTS_A_HAND: Final = 32
"""Part numbers per hand: a pixel of bone b of hand h has part 1 + b + 32 h; 0 is no hand."""


def triple(values: NDArray[np.floating]) -> tuple[float, float, float]:
    """The three numbers of an array (3,), such as a color or a direction, as plain values."""
    first, second, third = values.tolist()
    return first, second, third


def at_rest(camera: Camera) -> Camera:
    """A copy at the origin without a name, which is equal for cameras of the same size, matrix and lens."""
    return dataclasses.replace(camera, name="", K=camera.K.copy(), T_world_camera=np.eye(4))


@dataclass(frozen=True, slots=True, eq=False)
class Pictures:
    """The pictures of one frame; those that were not requested are None."""

    rgb: UInt8[np.ndarray, "H W 3"] | None = None
    """sRGB."""
    light: Float16[np.ndarray, "H W 3"] | None = None
    """Linear light of the colors, 1 for white, with highlights beyond; only where EXR files are written."""
    depth: Float32[np.ndarray, "H W"] | None = None
    """Distance along the camera's axis at each pixel's center [m]; 0 where there is nothing."""
    normals: Float32[np.ndarray, "H W 3"] | None = None
    """Unit normals of the surface in the camera's axes; 0 where there is nothing."""
    parts: UInt8[np.ndarray, "H W"] | None = None
    """Bone of each pixel's hand, see `PARTS_A_HAND`."""
    instances: UInt8[np.ndarray, "H W"] | None = None
    """1, 2, ... for the hands in their order, then the bodies; 0 for the background.

    A hand's forearm and markers have the number of the hand.
    """
    markers: UInt8[np.ndarray, "H W"] | None = None
    """1 + marker of each pixel, counted over all hands; 0 for no marker."""


class Geometry(NamedTuple):
    """Depth, normals and ids of surfaces in a camera's picture, as in `Pictures`."""

    depth: Float32[np.ndarray, "H W"]
    normals: Float32[np.ndarray, "H W 3"] | None
    parts: UInt8[np.ndarray, "H W"]
    instances: UInt8[np.ndarray, "H W"]
    markers: UInt8[np.ndarray, "H W"]


class Footage(Protocol):
    """Pictures that a real camera took of a take's hands; they replace drawn colors. It can be pickled."""

    @property
    def poses(self) -> Float[np.ndarray, "T 4 4"]:
        """Pose of the camera in each frame of the take [m]."""

    @property
    def record(self) -> dict[str, Any]:
        """The origin of the pictures, as JSON."""

    def picture(self, frame: int) -> Bytes:
        """The picture (sRGB) of a frame."""


@dataclass(frozen=True, slots=True, eq=False)
class HandTruth:
    """One hand of a frame."""

    shape: HandShape
    """Shape and side of the hand."""
    qpos: Float[np.ndarray, "27"]
    """Wrist position [m], wrist orientation (wxyz), joint angles [rad]."""
    keypoints: Float[np.ndarray, "21 2"]
    """Keypoints in the picture or beside it [px], see `handsim.hand.model`; NaN where the lens cannot see
    them."""
    keypoints_world: Float[np.ndarray, "21 3"]
    """The same keypoints in the world [m]; `frame.camera.local` gives them in the camera's axes."""
    visible: Bool[np.ndarray, "21"]
    """Whether each keypoint is in the picture on a pixel of its own finger, and no deeper under the surface
    there than the finger is thick."""
    box: Float[np.ndarray, "4"]
    """Left, top, width, height [px] of the visible hand without its forearm; NaN where none is visible."""
    mask: Bool[np.ndarray, "H W"]
    """Pixels of the visible hand with its markers, without its forearm."""
    vertices: Float32[np.ndarray, "V 3"]
    """`HandModel.skin` in the world [m]; on pictures of bare hands joints shape it further."""
    openxr: Float[np.ndarray, "J 4 4"] = field(default_factory=lambda: np.empty((0, 4, 4)))
    """Poses in the world [m] of OpenXR's 26 joints; none unless `RenderConfig.openxr` asks for them."""
    openxr_visible: Bool[np.ndarray, "J"] = field(default_factory=lambda: np.empty(0, dtype=bool))
    """Whether they are visible, as of keypoints; those in the palm are on its pixels."""
    tracking: Mapping[str, Any] | None = None
    """Status, RMS [m] and standard deviations ([rad], [m]) of a tracked pose; None for others."""
    mano: Mapping[str, Any] | None = None
    """Parameters of `RenderConfig.mano` in the camera's axes, and the error [mm]; None without it."""
    marker_names: tuple[str, ...] = ()
    markers: Float[np.ndarray, "M 3"] = field(default_factory=lambda: np.empty((0, 3)))
    """Centers of the glove's markers as the pose has them, in the world [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyTruth:
    """One rigid body of a frame."""

    name: str
    T_world_body: Float[np.ndarray, "4 4"]
    """Pose in the world [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class RenderedFrame:
    """Pictures of one camera at one time, and their ground truth."""

    number: int
    """Number of the frame in the take."""
    time: float
    """Time in the take [s]."""
    camera: Camera
    hands: tuple[HandTruth, ...]
    bodies: tuple[BodyTruth, ...]
    ideal: Pictures
    """Pictures of a perfect sensor."""
    noisy: Pictures
    """Colors and depth of the simulated sensors; None for those without noise."""
    points: Float[np.ndarray, "N 3"]
    """Points that the optical system saw, in the world [m]."""
    labels: Int[np.ndarray, "N"]
    """Index of each point's label in `label_names`; -1 for a ghost."""
    label_names: tuple[str, ...]
    choices: Mapping[str, Any]
    """Every random choice that made the pictures, as JSON."""

    def __repr__(self) -> str:
        """What the frame holds, without its arrays."""
        hands = " and ".join(hand.shape.side for hand in self.hands) or "no hands"
        size = " x ".join(map(str, self.camera.size))
        return f"RenderedFrame({self.key} at {self.time:.3f} s, {size}: {hands}; {len(self.points)} points)"

    @property
    def rgb(self) -> UInt8[np.ndarray, "H W 3"] | None:
        """The perfect color picture (sRGB); `noisy.rgb` is the simulated sensor's."""
        return self.ideal.rgb

    @property
    def depth(self) -> Float32[np.ndarray, "H W"] | None:
        """The true depth [m]; `noisy.depth` is the simulated sensor's."""
        return self.ideal.depth

    @property
    def normals(self) -> Float32[np.ndarray, "H W 3"] | None:
        """The true normals."""
        return self.ideal.normals

    @property
    def ids(self) -> UInt8[np.ndarray, "H W"] | None:
        """Number of the hand or body in each pixel, 0 for the background: `ideal.instances`."""
        return self.ideal.instances

    @property
    def key(self) -> str:
        """Name of the frame in files: camera and number."""
        return f"{self.camera.name}_{self.number:06d}"
