"""From unlabeled marker clouds to hand motion, online."""

from handsim import __version__  # the first import: a hidden sibling is told before it hurts

__all__ = ["__version__"]
