"""Live streams of points.

`natnet`: packets of OptiTrack's NatNet protocol.
`frame_order`: which frames of a stream go on, in which order.
`point_stream`: a live stream of points from a NatNet server.
`natnet_server`: a NatNet server that replays a capture.
"""
