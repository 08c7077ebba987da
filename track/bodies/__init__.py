"""Rigid bodies with markers of their own, tracked beside the hands."""
