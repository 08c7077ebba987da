"""Marker files in and out: TRC and C3D both ways, Motive CSV in.

- capture: `Capture`, named trajectories at a rate
- formats: `read_capture` and `write_capture`, by suffix
- trc, c3d, motive_csv: one format each
- _text, _c3d_parameters: parsing that they share
- collection: many captures as one stack of frames
- plausibility: wrong units, and zeros for missing points
- markers: between a capture's columns and a glove's markers
- gaps: gaps counted as in the paper's Table 3
"""
