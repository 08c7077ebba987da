"""Training data: files, batches and their augmentation.

- shards: a training set on disk: `.npy` shards and a manifest; `Dataset` reads it.
- mapped_rows: the rows of a set as they are in its files (`MappedRows`).
- batches: random rows, stretched, mirrored and centered, as batches.
- own_corruption: corruption by a user's own function.
- augmentation: jitter, occlusion, ghosts and random order (`Corruption`, `corrupt`).
"""
