"""Data association: which point is which marker of which hand, and initialization without history.

A frame passes through these steps as a `FrameState`:

- `frame_state`: points of a frame with persistent numbers, and the labels that these carry over.
- `hand_state`: filter state of one hand: prediction, fit, update, and the learned bias of each marker.
- `label_consistency`: tests of kept labels: exchanges, gate, fit, and comparison with the labeler's labels.
- `label_new_points`: labels of new points: of a palm, and the best joint assignment of all digits.
- `digit_hypotheses`: every assignment of a digit's candidates to its markers, fitted and scored.
- `initialization`: hands without history, from labeled clouds, and labels of single frames.
"""
