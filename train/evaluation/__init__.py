"""Evaluation of labelers: corrupt, label, count, and compare with the tables of Han et al. 2018.

- labeler_evaluation: labels known markers or takes and collects a `Report`.
- metrics: accuracy, precision and recall of slots, points, occlusions and ghosts.
- matching_costs: the costs of matching for the paper's network, chosen on held-out frames.
- reliability: calibration of the confidences.
- paper: the printed figures of the paper's Tables 2, 4 and 6.
- tables: our figures beside the paper's, as tables.
"""
