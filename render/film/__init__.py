"""Hands in pictures that a camera took: they are found, and registered to a tracked take."""
