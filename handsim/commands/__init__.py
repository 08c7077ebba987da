"""The commands of `handsim` that need no other package, one per file.

- demo: the whole chain on a built-in example
- doctor: what is missing on this machine
- rig_import: a rig of the calibration that another program wrote
"""
