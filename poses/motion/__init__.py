"""Motions of one hand."""
