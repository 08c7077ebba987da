"""The hand itself, and the types that the other packages share."""

from handsim._siblings import ShadowedPackageWarning, warn_if_shadowed
from handsim._version import __version__
from handsim.errors import HandSimError

__all__ = ["HandSimError", "ShadowedPackageWarning", "__version__"]

warn_if_shadowed()
