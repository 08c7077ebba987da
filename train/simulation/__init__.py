"""Simulated captures: a take or a training frame flows from people to motion, sight, optics and file.

Settings:
- room_settings: the capture room, and the rates fitted to the paper's four captures (`TWINS`).
- dataset_config: everything that decides the bytes of a training set.

Takes, continuous and with IDs:
- people: random hands, and the gloves as they are worn; training frames use it too.
- motion: what hands and an object do, for each kind of capture.
- real_like: takes whose people, speed and skin are like those of published captures.
- sight: which cameras have a free view of which marker.
- light_sources: markers, mirror images and stray reflections with their views.
- room: light sources through the optical system into a `Take`.
- takes: `simulate_take` composes these.
- calibration_take: the capture that a user makes for calibration.

Training sets, frame by frame:
- frame_scenes: poses of one hand, two hands, or a hand with an object.
- training_frames: such poses through sight and optics into rows.
- generation: `make_dataset` writes rows in shards, with a manifest.
"""
