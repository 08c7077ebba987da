"""Labelers: networks that give every point of a frame its marker, and what turns their scores into labels."""
