"""Pictures of hands with exact ground truth.

`draw` yields pictures of a take or of your own poses in memory, `render_take` writes them into files,
`PictureStream` feeds a training loop without end. A `RenderConfig` says what is drawn, a `ViewConfig` from
where. `merge_renderings` makes one folder of several.
"""

from typing import TYPE_CHECKING

from handsim import __version__ as __version__  # the first import: it warns about a package of the same name
from handsim._imports import lazy_exports

if TYPE_CHECKING:
    from render.color_sensor import ExposureConfig as ExposureConfig
    from render.color_sensor import ShutterConfig as ShutterConfig
    from render.config import FrameConfig as FrameConfig
    from render.config import RenderConfig as RenderConfig
    from render.depth_sensor import DepthSensor as DepthSensor
    from render.drawing import draw as draw
    from render.formats.writer import merge_renderings as merge_renderings
    from render.frames import BodyTruth as BodyTruth
    from render.frames import HandTruth as HandTruth
    from render.frames import Pictures as Pictures
    from render.frames import RenderedFrame as RenderedFrame
    from render.scene_file import write_scene as write_scene
    from render.scenery.backgrounds import Backgrounds as Backgrounds
    from render.scenery.lights import write_environment_map as write_environment_map
    from render.session import render_take as render_take
    from render.skin.look import SkinLook as SkinLook
    from render.stream import PictureStream as PictureStream
    from render.subject import PoseFile as PoseFile
    from render.viewpoints import ViewConfig as ViewConfig

__getattr__, __dir__ = lazy_exports(__name__)
