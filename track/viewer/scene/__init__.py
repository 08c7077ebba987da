"""What stands in the page.

`stage`: light, ground and the first look.
`hand_skin`: a hand's skin, moved by its bones.
`point_balls`: points in the colors of their labels, and names.
`rig_view`: cameras and what they see.
`frame_view`: a frame of a recording, of which only what changed is sent.
"""
