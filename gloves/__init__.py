"""Markers on the hand, and what an optical system sees of them.

A `MarkerLayout` (a TOML file) is put on a hand by `attach`; the result is a `GloveFit`. `read_capture` and
`write_capture` read and write marker files of other programs. A `Take` has hands over time, what was seen of
them and the labels, simulated or tracked; `load_take` reads one.
"""

from typing import TYPE_CHECKING

from handsim import __version__  # the first import: it warns about a package of the same name
from handsim._lazy import lazy_exports

if TYPE_CHECKING:
    from gloves.attachment import Attachment
    from gloves.captures.capture import Capture
    from gloves.captures.formats import read_capture, write_capture
    from gloves.fit import GlovedHand, GloveFit, attach
    from gloves.layout import MarkerLayout, MarkerPlace, load_layout
    from gloves.takes.points import PointList
    from gloves.takes.status import Status
    from gloves.takes.take import RigidBody, Take, load_take

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Attachment": "gloves.attachment",
        "Capture": "gloves.captures.capture",
        "GloveFit": "gloves.fit",
        "GlovedHand": "gloves.fit",
        "MarkerLayout": "gloves.layout",
        "MarkerPlace": "gloves.layout",
        "PointList": "gloves.takes.points",
        "RigidBody": "gloves.takes.take",
        "Status": "gloves.takes.status",
        "Take": "gloves.takes.take",
        "attach": "gloves.fit",
        "load_layout": "gloves.layout",
        "load_take": "gloves.takes.take",
        "read_capture": "gloves.captures.formats",
        "write_capture": "gloves.captures.formats",
    },
)

__all__ = [
    "Attachment",
    "Capture",
    "GloveFit",
    "GlovedHand",
    "MarkerLayout",
    "MarkerPlace",
    "PointList",
    "RigidBody",
    "Status",
    "Take",
    "__version__",
    "attach",
    "load_layout",
    "load_take",
    "read_capture",
    "write_capture",
]
