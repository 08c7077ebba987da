"""Space around the hand: frames, cameras and objects.

- transforms: rotations and rigid transforms on numpy arrays
- lens: lens models (pinhole, Brown-Conrady, Kannala-Brandt) and their inverses
- camera: `Camera`, one calibrated camera with its pose, and the presets
- cameras: `CameraRig`, shipped rigs and rigs from files
- rig_file: the TOML form of a rig
- camera_file: the TOML form of cameras with lenses of their own
- rig_formats: calibrations of cameras as other programs write them
- solids: the simple solids that objects are made of
- objects: rigid objects that a hand holds
"""
