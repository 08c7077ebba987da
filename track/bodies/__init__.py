"""Rigid bodies, found by their constellations of markers."""
