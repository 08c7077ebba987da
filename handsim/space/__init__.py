"""Space around the hand: frames, cameras and objects.

- transforms: rotations and rigid transforms on numpy arrays
- lens: lens models (pinhole, Brown-Conrady, Kannala-Brandt) and their inverses
- camera: `Camera`, one calibrated camera with its pose, and the presets
- cameras: `CameraRig`, a tuple of cameras: shipped, from files, or your own
- rig_file: the TOML form of cameras
- rig_formats: calibrations of cameras as other programs write them
- solids: the simple solids that objects are made of
- objects: rigid objects that a hand holds
"""
