"""Marker files in and out: TRC, C3D and Motive CSV both ways, Vicon CSV and Qualisys TSV in.

- capture: `Capture`, named trajectories at a rate
- formats: `read_capture` and `write_capture`, by suffix
- trc, c3d, motive_csv, vicon_csv, qtm_tsv: one format each
- _text: parsing that they share
- frame_times: rate, times and numbers of frames, which have to agree
- _c3d_parameters, _c3d_frames: the two parts of a C3D file
- collection: many captures as one stack of frames
- plausibility: wrong units, and zeros for missing points
- markers: between a capture's columns and a glove's markers
- gaps: gaps counted as in the paper's Table 3
"""
