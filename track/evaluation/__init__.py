"""Evaluation of trackers and calibrations against simulated truth.

`take_evaluation`: labels, poses and time of a tracker on a take.
`trials`: initialization and recovery of a tracker.
`comparison`: all trackers on the same takes.
`paper`: the tracking results of Han et al. 2018.
`tables`: tables of results beside the paper's.
`hand_errors`: errors of a calibrated hand.
`sweep`: gloves x rigs x people x seeds as one job.
`take_summary`: summary of a tracked take as text.
"""
