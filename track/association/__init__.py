"""Data association: which point is which marker of which hand, and hands among points without history.

A frame goes through these steps as a `FrameState`, which each replaces by the next:

- `frame_state`: the points of a frame, numbers of them that last, and the labels that these carry over.
- `hand_state`: filter state of one hand: prediction, fit, update, and the learned bias of each marker.
- `label_consistency`: kept labels: exchanged, gated, tested by the fit, and compared with the labeler's.
- `label_new_points`: labels for new points: those of a palm, and the best combination of all digits'.
- `digit_hypotheses`: every assignment of a digit's candidates to its markers, fitted and scored.
- `initialization`: hands without history, from labeled clouds, and frames labeled by themselves.
"""
