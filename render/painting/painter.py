"""Colors and coverage of surfaces by either painter, and pictures over backgrounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from handsim.kernels import kernel
from handsim.space.camera import Camera
from render.painting.compiled_painter import paint_compiled
from render.painting.figures import Drawn
from render.painting.gl import opengl_has_hardware
from render.painting.opengl_painter import paint_opengl
from render.painting.rasterizer import NEAR
from render.scenery.lights import Lighting

Painter = Literal["compiled", "opengl"]
PainterChoice = Literal["auto", "compiled", "opengl"]
_WHITE: Final = np.float32(255.0)
_STEP: Final = 64  # [px] that windows grow by: every new size makes OpenGL reallocate its buffers


def choose_painter(choice: PainterChoice) -> Painter:
    """The painter itself; `auto` is OpenGL where it draws on hardware, and our own painter elsewhere."""
    if choice == "auto":
        return "opengl" if opengl_has_hardware() else "compiled"
    return choice


def paint(
    camera: Camera, drawn: Sequence[Drawn], lighting: Lighting, painter: Painter = "compiled"
) -> UInt8[np.ndarray, "H W 4"]:
    """Colors over black (sRGB) by a pinhole camera, and fourth the covered share of each pixel.

    Light is in the camera's axes; both painters give nearly the same picture.

    Raises:
        HandSimError: OpenGL is requested and missing on this machine; the message says what to install.
    """
    paint_colors = {"compiled": paint_compiled, "opengl": paint_opengl}[painter]
    width, height = camera.size
    picture = np.zeros((height, width, 4), dtype=np.uint8)
    left, top, right, bottom = _window(camera, drawn)
    if left < right and top < bottom:
        inner = camera.part(left, top, right - left, bottom - top)
        picture[top:bottom, left:right] = paint_colors(inner, drawn, lighting)
    return picture


def _window(camera: Camera, drawn: Sequence[Drawn]) -> tuple[int, int, int, int]:
    """Left, top, right, bottom [px] of the part with surfaces: empty parts cost time too."""
    width, height = camera.size
    if not drawn:
        return 0, 0, 0, 0
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for one in drawn:
        _widen(camera.local(one.triangles.vertices), camera.K, low, high)
    if low[2] < NEAR:
        return 0, 0, width, height
    low, high = np.floor(low[:2] - 1.0), np.ceil(high[:2] + 1.0)
    left, top = (np.clip(low, 0, camera.size) // _STEP * _STEP).astype(int)
    right, bottom = np.minimum(np.ceil(np.clip(high, 0, camera.size) / _STEP) * _STEP, camera.size).astype(
        int
    )
    return int(left), int(top), int(right), int(bottom)


@kernel
def _widen(
    local: NDArray[np.float64], K: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> None:
    """Widen a range (3,) of columns, rows [px] and depths [m] to points in the camera's axes (V, 3)."""
    for point in range(len(local)):
        depth = local[point, 2]
        low[2], high[2] = min(low[2], depth), max(high[2], depth)
        for axis in range(2):
            place = local[point, axis] / depth * K[axis, axis] + K[axis, 2]
            low[axis], high[axis] = min(low[axis], place), max(high[axis], place)


def put_before(
    painted: UInt8[np.ndarray, "H W 4"], background: Float32[np.ndarray, "H W 3"]
) -> UInt8[np.ndarray, "H W 3"]:
    """A picture of `paint` over a background.

    Args:
        painted: See `paint`.
        background: sRGB from 0 to 255.
    """
    mixed = np.empty_like(background, dtype=np.uint8)
    _mix(painted.reshape(-1, 4), background.reshape(-1, 3), mixed.reshape(-1, 3))
    return mixed


@kernel
def _mix(painted: NDArray[np.uint8], background: NDArray[np.float32], mixed: NDArray[np.uint8]) -> None:
    """Write painted colors with coverage (P, 4) over a background; see `put_before`."""
    behind, bare = background.reshape(-1), mixed.reshape(-1)
    for n in range(len(bare)):
        bare[n] = np.int32(behind[n] if behind[n] < _WHITE else _WHITE)
    for pixel in range(len(mixed)):
        if painted[pixel, 3]:
            clear = 1.0 - painted[pixel, 3] / 255.0
            for channel in range(3):
                value = painted[pixel, channel] + clear * background[pixel, channel]
                mixed[pixel, channel] = int(min(value, 255.0))
