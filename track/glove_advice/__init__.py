"""Advice on marker layouts: how well one can be labeled, what it tells of each joint, and a better one."""
