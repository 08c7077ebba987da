"""Compiled arithmetic on plain arrays, shared by all packages.

- rotations: axis and angle, quaternions, 3x3 matrices
- chain: forward kinematics of a chain of bones
- integration: poses along MuJoCo's velocities
- segments: distance between two segments
"""
