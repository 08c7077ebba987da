"""Baseline trackers, to compare ours with.

`clustering`: clusters of points that may be one hand each.
`proposals`: label proposals for new points of a hand.
`plain_hand`: a hand whose only state is its last pose.
`paper_tracker`: the tracking loop of Han et al. 2018.
`assignment_trackers`: nearest-neighbor and Hungarian labeling.
"""
