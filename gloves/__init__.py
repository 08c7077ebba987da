"""Markers on the hand, and what an optical system sees of them.

A `MarkerLayout` (a TOML file) is put on a hand by `attach`; the result is a `GloveFit`. `read_capture` and
`write_capture` read and write marker files of other programs. A `Take` has hands over time, what was seen of
them and the labels, simulated or tracked; `load_take` reads one.
"""

from typing import TYPE_CHECKING

from handsim import __version__ as __version__  # the first import: it warns about a package of the same name
from handsim._imports import lazy_exports

if TYPE_CHECKING:
    from gloves.captures.capture import Capture as Capture
    from gloves.captures.formats import read_capture as read_capture
    from gloves.captures.formats import write_capture as write_capture
    from gloves.fit import Attachment as Attachment
    from gloves.fit import GlovedHand as GlovedHand
    from gloves.fit import GloveFit as GloveFit
    from gloves.fit import attach as attach
    from gloves.layout import MarkerLayout as MarkerLayout
    from gloves.layout import MarkerPlace as MarkerPlace
    from gloves.layout import load_layout as load_layout
    from gloves.optics.ghosts import GhostConfig as GhostConfig
    from gloves.optics.reconstruction import FrameOptics as FrameOptics
    from gloves.optics.reconstruction import OpticsConfig as OpticsConfig
    from gloves.takes.bodies import RigidBody as RigidBody
    from gloves.takes.points import PointList as PointList
    from gloves.takes.points import Status as Status
    from gloves.takes.take import Take as Take
    from gloves.takes.take import load_take as load_take

__getattr__, __dir__ = lazy_exports(__name__)
