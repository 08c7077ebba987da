"""Pose estimation: from labeled markers to the pose of a hand, with priors and covariances.

In the order of the data's flow:

- `marker_kinematics`: forward kinematics of the markers, their Jacobian and normal equations.
- `starting_poses`: initial poses without an earlier one.
- `joint_prior`: prior of the hinge angles, predicted over time.
- `levenberg_marquardt`: the optimizer of one hand's pose, and solvers of small positive-definite systems.
- `frame_fits`: the compiled loop over frames: starts, prior, robust scale, residuals.
- `pose_solver`: poses from labeled markers, frame by frame; the class that others use.
- `marker_prediction`: predicted positions of all markers at a fitted pose, with covariances.
"""
