"""Pictures of hands with exact ground truth.

`draw` yields pictures of a take or of your own poses in memory, `render_take` writes them into files,
`PictureStream` feeds a training loop without end. A `RenderConfig` says what is drawn, a `ViewConfig` from
where. `merge_renderings` makes one folder of several.
"""

from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from render.cameras.viewpoints import ViewConfig
    from render.config import RenderConfig
    from render.drawing import draw
    from render.formats.merging import merge_renderings
    from render.frames import BodyTruth, HandTruth, Pictures, RenderedFrame
    from render.scenery.backgrounds import Backgrounds
    from render.sensors.depth_noise import DepthSensor
    from render.sensors.exposure import ExposureConfig
    from render.sensors.shutter import ShutterConfig
    from render.session import render_take
    from render.skin.look import SkinLook
    from render.stream import PictureStream
    from render.subject import PoseFile

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Backgrounds": "render.scenery.backgrounds",
        "BodyTruth": "render.frames",
        "DepthSensor": "render.sensors.depth_noise",
        "ExposureConfig": "render.sensors.exposure",
        "HandTruth": "render.frames",
        "PictureStream": "render.stream",
        "Pictures": "render.frames",
        "PoseFile": "render.subject",
        "RenderConfig": "render.config",
        "RenderedFrame": "render.frames",
        "ShutterConfig": "render.sensors.shutter",
        "SkinLook": "render.skin.look",
        "ViewConfig": "render.cameras.viewpoints",
        "draw": "render.drawing",
        "merge_renderings": "render.formats.merging",
        "render_take": "render.session",
    },
)

__all__ = [
    "Backgrounds",
    "BodyTruth",
    "DepthSensor",
    "ExposureConfig",
    "HandTruth",
    "PictureStream",
    "Pictures",
    "PoseFile",
    "RenderConfig",
    "RenderedFrame",
    "ShutterConfig",
    "SkinLook",
    "ViewConfig",
    "__version__",
    "draw",
    "merge_renderings",
    "render_take",
]
