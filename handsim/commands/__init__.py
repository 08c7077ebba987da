"""The commands of `handsim` that need no other package, one per file.

- demo: the whole chain on a built-in example
- doctor: what is missing on this machine
"""
