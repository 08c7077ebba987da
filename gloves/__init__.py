"""Markers on the hand, and what an optical system sees of them."""

from handsim import __version__  # the first import: a hidden sibling is told before it hurts

__all__ = ["__version__"]
