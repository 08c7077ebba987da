"""Where valid hand poses and motions come from."""

from handsim import __version__  # the first import: a hidden sibling is told before it hurts

__all__ = ["__version__"]
