"""The hand itself, and the types that all packages share.

A `HandShape` (lengths, breadths and girths in meters) becomes a `HandModel`: skeleton, capsules, skin and a
compiled MuJoCo model with 26 degrees of freedom. Poses are MuJoCo's qpos, (T, 27): wrist position [m],
wrist orientation (wxyz), twenty joint angles [rad]. A `CameraRig` is a set of cameras around the hands.
"""

from typing import TYPE_CHECKING

from handsim._kernel_cache import ensure_kernel_cache
from handsim._lazy import lazy_exports
from handsim._siblings import ShadowedPackageWarning, warn_if_shadowed
from handsim._version import __version__
from handsim.errors import HandSimError, HandSimWarning

if TYPE_CHECKING:
    from handsim.hand.model import HandModel, join_qpos
    from handsim.hand.motion import HandMotion
    from handsim.hand.shape import HandShape, Population, sample_shape
    from handsim.pages import write_page
    from handsim.space.camera import Camera, look_at
    from handsim.space.cameras import CameraRig, load_rig
    from handsim.space.lens import Lens
    from handsim.space.objects import RigidObject

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Population": "handsim.hand.shape",
        "Camera": "handsim.space.camera",
        "CameraRig": "handsim.space.cameras",
        "HandModel": "handsim.hand.model",
        "HandMotion": "handsim.hand.motion",
        "HandShape": "handsim.hand.shape",
        "Lens": "handsim.space.lens",
        "join_qpos": "handsim.hand.model",
        "look_at": "handsim.space.camera",
        "load_rig": "handsim.space.cameras",
        "RigidObject": "handsim.space.objects",
        "sample_shape": "handsim.hand.shape",
        "write_page": "handsim.pages",
    },
)

__all__ = [
    "Camera",
    "CameraRig",
    "HandModel",
    "HandMotion",
    "HandShape",
    "HandSimError",
    "HandSimWarning",
    "Lens",
    "Population",
    "RigidObject",
    "ShadowedPackageWarning",
    "__version__",
    "join_qpos",
    "load_rig",
    "look_at",
    "sample_shape",
    "write_page",
]

ensure_kernel_cache()
warn_if_shadowed()
