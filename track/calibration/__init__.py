"""Calibration of a user's hands and gloves from captures of them."""
