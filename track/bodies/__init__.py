"""Rigid bodies with markers of their own, tracked beside the hands.

`body_file`: bodies as TOML files.
`body_pose`: poses of bodies: matrices, markers and velocities (kernels).
`constellation`: pose of a body from assigned points (kernels).
`constellation_search`: search for a body among all points (kernels).
`rigid_body`: the markers of a body, and the tracker of one body.
"""
