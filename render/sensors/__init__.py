"""Noise of sensors on perfect pictures."""
