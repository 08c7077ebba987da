"""Where valid hand poses and motions come from.

`sample_poses` draws random poses, `sample_motion` smooth motions through them. `validate` says which poses
are within the joint ranges and do not penetrate the hand. `load_gestures` gives the named hand shapes. A
sampler of your own is any callable that fulfills `PoseSampler`.
"""

from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from poses.motion.motions import sample_motion
    from poses.motion.paths import MotionConfig
    from poses.shapes.library import load_gestures
    from poses.shapes.sampling import PoseSampler, sample_poses
    from poses.shapes.validity import validate

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "MotionConfig": "poses.motion.paths",
        "PoseSampler": "poses.shapes.sampling",
        "load_gestures": "poses.shapes.library",
        "sample_motion": "poses.motion.motions",
        "sample_poses": "poses.shapes.sampling",
        "validate": "poses.shapes.validity",
    },
)

__all__ = [
    "MotionConfig",
    "PoseSampler",
    "__version__",
    "load_gestures",
    "sample_motion",
    "sample_poses",
    "validate",
]
