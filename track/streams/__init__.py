"""Live streams of points.

`addresses`: opens the stream that an address names.
`frame_source`: frames of points, of captures, live streams and sources of the user's own.
`natnet`: packets of OptiTrack's NatNet protocol.
`frame_order`: which frames of a stream go on, in which order.
`point_stream`: a live stream of points from a NatNet server.
`qualisys`: frames from Qualisys Track Manager.
`natnet_server`: a NatNet server that replays a capture.
"""
