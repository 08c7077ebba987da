"""Pose estimation: from labeled markers to the pose of a hand, with priors and covariances.

- `marker_kinematics`: forward kinematics of the markers, their Jacobian, and the optimizer of one pose.
- `pose_solver`: poses from labeled markers, frame by frame; the class that others use.
- `pose_spread`: priors and covariances: of hinges over time, of predicted markers, of joints and keypoints.
"""
