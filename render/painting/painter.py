"""Colors and coverage of surfaces by either painter, and pictures over backgrounds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.typing import NDArray

from handsim.kernels.kernel import kernel
from handsim.space.camera import Camera
from render.painting.compiled_painter import paint_compiled
from render.painting.figures import Drawn
from render.painting.gl import opengl_has_hardware
from render.painting.opengl_painter import paint_opengl
from render.painting.rasterizer import NEAR
from render.scenery.lights import Lighting

Painter = Literal["compiled", "opengl"]
PainterChoice = Literal["auto", "compiled", "opengl"]
_WHITE: Final = 255.0
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
    local = camera.local(np.concatenate([one.triangles.vertices for one in drawn]))
    x, y, depth = np.ascontiguousarray(local.T)  # rows, whose extremes are found ten times as fast
    if depth.min() < NEAR:
        return 0, 0, width, height
    pixels = np.stack(
        [x / depth * camera.K[0, 0] + camera.K[0, 2], y / depth * camera.K[1, 1] + camera.K[1, 2]]
    )
    low, high = np.floor(pixels.min(axis=1) - 1.0), np.ceil(pixels.max(axis=1) + 1.0)
    left, top = (np.clip(low, 0, camera.size) // _STEP * _STEP).astype(int)
    right, bottom = np.minimum(np.ceil(np.clip(high, 0, camera.size) / _STEP) * _STEP, camera.size).astype(
        int
    )
    return int(left), int(top), int(right), int(bottom)


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
    for pixel in range(len(mixed)):
        clear = 1.0 - painted[pixel, 3] / _WHITE
        for channel in range(3):
            mixed[pixel, channel] = int(
                min(painted[pixel, channel] + clear * background[pixel, channel], _WHITE)
            )
