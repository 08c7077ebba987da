"""Rendered frames as the files of other people's datasets have them: one module a format, no pictures."""
