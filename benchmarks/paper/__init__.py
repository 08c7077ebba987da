"""The tables of Han et al. 2018, its tracker and two older ones: `python -m benchmarks.paper TABLE`.

`labeling_tables`: Tables 2, 3, 4 and 6.
`tracking_tables`: Tables 5 and 7, and few cameras.
`printed`: the figures that the paper prints.
`comparison`: all trackers on the same takes.
`take_evaluation`: labels, poses and time of a tracker on a take.
`trials`: initialization and recovery of a tracker.
`hand_errors`: errors of a calibrated hand.
`paper_tracker`: the tracking loop of the paper.
`assignment_trackers`: nearest-neighbor and Hungarian labeling.
`plain_hand`: a hand whose only state is its last pose; labels by proximity.
"""
