"""Pose estimation: poses of a hand from labeled markers, with priors and covariances.

- `marker_kinematics`: forward kinematics of the markers, their Jacobian, and the optimizer of one pose.
- `pose_solver`: poses from labeled markers, frame by frame; the class for other modules.
- `pose_spread`: priors and covariances of joint angles over time, predicted markers and keypoints.
"""
