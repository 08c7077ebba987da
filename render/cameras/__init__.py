"""The cameras of pictures: what they are, where they stand, and how their lenses distort.

- lens: lens models (pinhole, Brown-Conrady, Kannala-Brandt) and their inverses.
- camera: `Camera`, a calibrated camera with its pose, and the presets.
- viewpoints: the cameras of each frame of a take (still, orbit, head, anywhere, rig).
- warp: pictures through a lens, resampled from pinhole pictures.
"""
