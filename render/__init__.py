"""Pictures of hands with exact ground truth.

`render_take` writes colors, depth, normals, ids and annotations of a whole take; `draw_frames` yields
single `RenderedFrame`s in memory. A `RenderConfig` says what is drawn.
A `PoseFile` has poses of your own, which `render_take` draws too; `merge_renderings` makes one folder of
several.
"""

from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from render.cameras.viewpoints import ViewConfig
    from render.config import RenderConfig
    from render.formats.merging import merge_renderings
    from render.frames.frame import RenderedFrame
    from render.own_poses import PoseFile
    from render.session import draw_frames, render_take
    from render.skin.look import SkinLook

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "PoseFile": "render.own_poses",
        "RenderConfig": "render.config",
        "RenderedFrame": "render.frames.frame",
        "SkinLook": "render.skin.look",
        "ViewConfig": "render.cameras.viewpoints",
        "draw_frames": "render.session",
        "merge_renderings": "render.formats.merging",
        "render_take": "render.session",
    },
)

__all__ = [
    "PoseFile",
    "RenderConfig",
    "RenderedFrame",
    "SkinLook",
    "ViewConfig",
    "__version__",
    "draw_frames",
    "merge_renderings",
    "render_take",
]
