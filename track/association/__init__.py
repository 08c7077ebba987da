"""Data association: which point is which marker of which hand, and hands among points without history.

A frame goes through these steps as a `FrameState`, which each replaces by the next:

- `frame_state`: the points of a frame and what is known of each; the one numbering of all markers.
- `hand_state`: filter state of one hand: prediction, fit, update, and the learned bias of each marker.
- `point_linking`: numbers of points that last, and the labels that these carry over.
- `label_consistency`: labels that go along with IDs: exchanged, gated by the predicted pose, then by the fit.
- `label_new_points`: labels for new points; the steps below serve it.
- `candidates`: candidate points of each digit.
- `digit_hypotheses`: every assignment of a digit's candidates to its markers, fitted and scored.
- `digit_fit`: the fit of one such assignment.
- `assignment`: points to markers one to one: those of a palm, and the best combination of all digits'.
- `labeler_review`: the labeler's own labels of a hand's points, fitted and compared with those of the track.
- `initialization`: hands without history, from labeled clouds.
"""
