"""Calibrations of cameras as other programs write them, one file per format."""
