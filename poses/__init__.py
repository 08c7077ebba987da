"""Where valid hand poses and motions come from.

`sample_poses` draws random poses, `sample_motion` smooth motions through them. `validate` says which poses
are within the joint ranges and do not penetrate the hand. `load_gestures` gives the named hand shapes. A
sampler of your own is any callable that fulfills `PoseSampler`.
"""

from typing import TYPE_CHECKING

from handsim import __version__ as __version__  # the first import: it warns about a package of the same name
from handsim._imports import lazy_exports

if TYPE_CHECKING:
    from poses.motion import MotionConfig as MotionConfig
    from poses.motion import sample_motion as sample_motion
    from poses.shapes import PoseMix as PoseMix
    from poses.shapes import PoseSampler as PoseSampler
    from poses.shapes import load_gestures as load_gestures
    from poses.shapes import sample_poses as sample_poses
    from poses.shapes import validate as validate

__getattr__, __dir__ = lazy_exports(__name__)
