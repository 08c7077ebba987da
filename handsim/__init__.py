"""The hand itself, and the types that all packages share.

A `HandShape` (lengths, breadths and girths in meters) becomes a `HandModel`: skeleton, capsules, skin and a
compiled MuJoCo model with 26 degrees of freedom. Poses are MuJoCo's qpos, (T, 27): wrist position [m],
wrist orientation (wxyz), twenty joint angles [rad]. A `CameraRig` is a set of cameras around the hands.
"""

from typing import TYPE_CHECKING

from handsim._imports import ShadowedPackageWarning as ShadowedPackageWarning
from handsim._imports import ensure_kernel_cache, find_own_packages, lazy_exports, warn_if_shadowed
from handsim.errors import HandSimError as HandSimError
from handsim.errors import HandSimWarning as HandSimWarning

if TYPE_CHECKING:
    from handsim.hand.model import HandModel as HandModel
    from handsim.hand.model import HandMotion as HandMotion
    from handsim.hand.model import join_qpos as join_qpos
    from handsim.hand.shape import HandShape as HandShape
    from handsim.hand.shape import Population as Population
    from handsim.hand.shape import sample_shape as sample_shape
    from handsim.pages import write_page as write_page
    from handsim.space.camera import Camera as Camera
    from handsim.space.camera import Lens as Lens
    from handsim.space.camera import look_at as look_at
    from handsim.space.objects import RigidObject as RigidObject
    from handsim.space.rig import CameraRig as CameraRig
    from handsim.space.rig import load_rig as load_rig

__version__ = "0.2.0"
__getattr__, __dir__ = lazy_exports(__name__)

ensure_kernel_cache()
find_own_packages()
warn_if_shadowed()
