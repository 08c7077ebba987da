"""What a rendered frame holds: its pictures and the ground truth of them.

- keypoints: the 21 keypoints of a hand, their names and their skeleton.
- frame: `Pictures`, `HandTruth`, `BodyTruth` and `RenderedFrame`.
"""
