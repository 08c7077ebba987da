"""Live streams of points.

`addresses`: opens the stream that an address names.
`frame_source`: frames of points, of captures and sources of the user's own.
`live_stream`: live frames as a tracker takes them: in order, on one clock, and now.
`natnet`: packets of OptiTrack's NatNet protocol.
`frame_order`: which frames of a stream go on, in which order.
`point_stream`: frames from a NatNet server, as they arrive.
`qualisys`: frames from Qualisys Track Manager.
`natnet_server`: a NatNet server that replays a capture.
"""
