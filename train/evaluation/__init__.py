"""Evaluation of labelers: corrupt, label and count, as Han et al. 2018 do.

- labeler_evaluation: labels known markers or takes and collects a `Report`.
- metrics: accuracy, precision and recall of slots, points, occlusions and ghosts; calibration of confidences.
"""
