"""The cameras of pictures: where they stand, and what their lenses do to a picture.

- viewpoints: the cameras of each frame of a take (still, orbit, head, anywhere, rig).
- own_cameras: cameras from a user's file; opencv_file and colmap_file read what others wrote.
- warp: pictures through a lens, resampled from pinhole pictures.
"""
