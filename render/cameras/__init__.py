"""The cameras of pictures: where they stand, and what their lenses do to a picture.

- viewpoints: the cameras of each frame of a take (still, orbit, head, anywhere, rig), or around a hand.
- warp: pictures through a lens, resampled from pinhole pictures.
"""
