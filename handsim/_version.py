"""The version of handsim, stated here alone."""

__version__ = "0.1.0"
