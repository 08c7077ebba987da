"""From what a network says of points to one label per point, checked against hands that exist.

- assignment: from scores or distances to a one-to-one labeling with a reject option.
- pose_prior: how likely labeled points are as the markers of a hand in some pose.
- prior_learning: that prior from the frames of a training set.
- verification: the labelings nearest to the likeliest one compete by scores and prior.
"""
