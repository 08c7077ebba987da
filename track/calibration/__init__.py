"""Calibration of a user's hands and gloves, and of rigid bodies, from captures of them.

`skin_coordinates`: coordinates of points on the skin of a hand whose shape changes.
`hand_parameters`: a hand's shape as 53 parameters, their prior, jacobians of skinned points.
`frames`: frames of a capture that a calibration uses, and their poses.
`contacts`: detection of touches of the thumb, and contact points on the skin.
`energy`: the energy that is minimized, and its normal equations.
`solver`: Levenberg-Marquardt with the poses eliminated.
`report`: noise, standard errors, contact gaps and still joints.
`hand_size`: the size and proportions of hands from unlabeled points.
`user_calibration`: calibration of a hand in its glove from labeled markers, all steps.
`picture`: a picture of a calibration.
`body_learning`: calibration of a rigid body's markers.
"""
