"""Data association: which point is which marker of which hand, and hands among points without history.

In the order of a frame's way through it:

- `point_linking`: numbers of points that last, also where the stream's own IDs do not.
- `frame_state`: the points of a frame and what is known of each, the state that the steps share.
- `hand_state`: filter state of one hand: prediction, fit, update, and the learned bias of each marker.
- `label_consistency`: labels that go along with IDs: exchanged, gated by the predicted pose, then by the fit.
- `label_new_points`: labels for new points; the steps below serve it.
- `point_matching`: one-to-one matching of points with markers by log-odds; for the palm.
- `candidates`: candidate points of each digit.
- `digit_hypotheses`: every assignment of a digit's candidates to its markers, fitted and scored.
- `digit_fit`: the fit of one such assignment.
- `joint_assignment`: the best combination of the hypotheses of all digits that share candidates.
- `labeler_review`: the labeler's own labels of a hand's points, fitted and compared with those of the track.
- `initialization`: hands without history, from labeled clouds.
"""
