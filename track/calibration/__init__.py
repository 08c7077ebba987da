"""Calibration of a user's hands and gloves, and of rigid bodies, from captures of them."""
