"""Alternatives to the labels of a whole take: mistakes that are the same in every frame."""
