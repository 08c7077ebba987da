"""Motions of one hand.

- minimum_jerk: profile, limits of speed, straight paths
- rest_paths: valid paths from a pose to rest
- wrist_paths: paths of the wrist
- motions: random motion, and motion through given poses
- scripts: spelling, counting, touching, typing
"""
