"""Rigid bodies with markers of their own, tracked beside the hands.

`body_file`: bodies as TOML files.
`constellation`: pose of a body from assigned points, and its motion (kernels).
`constellation_search`: search for a body among all points (kernels).
`rigid_body`: the markers of a body, and the tracker of one body.
"""
