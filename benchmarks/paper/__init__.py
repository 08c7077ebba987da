"""The tables of Han et al. 2018, beside ours: `python -m benchmarks.paper TABLE`.

`labeling_tables`: Tables 3, 4 and 6.
`tracking_tables`: Tables 5 and 7, few cameras, and hands calibrated from a capture.
`printed`: the figures that the paper prints.
`take_evaluation`: labels and poses of a tracker on a take.
`hand_errors`: errors of a calibrated hand.
"""
