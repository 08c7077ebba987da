"""Pictures of hands with exact ground truth.

`render_take` writes colors, depth, normals, ids and annotations of a whole take; `draw_frames` yields
single `RenderedFrame`s in memory. A `RenderConfig` says what is drawn.
"""

from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from render.cameras.viewpoints import ViewConfig
    from render.config import RenderConfig
    from render.frames.frame import RenderedFrame
    from render.session import draw_frames, render_take
    from render.skin.look import SkinLook

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "RenderConfig": "render.config",
        "RenderedFrame": "render.frames.frame",
        "SkinLook": "render.skin.look",
        "ViewConfig": "render.cameras.viewpoints",
        "draw_frames": "render.session",
        "render_take": "render.session",
    },
)

__all__ = [
    "RenderConfig",
    "RenderedFrame",
    "SkinLook",
    "ViewConfig",
    "__version__",
    "draw_frames",
    "render_take",
]
