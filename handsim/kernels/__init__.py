"""Compiled arithmetic on plain arrays, shared by all packages."""
