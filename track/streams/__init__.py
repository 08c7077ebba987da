"""Live streams of points.

`natnet`: packets of OptiTrack's NatNet protocol.
`point_stream`: a live stream of points from a NatNet server.
`natnet_server`: a NatNet server that replays a capture.
"""
