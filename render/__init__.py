"""Pictures of hands with ground truth; the only package with a GL context."""

from handsim import __version__  # the first import: a hidden sibling is told before it hurts

__all__ = ["__version__"]
