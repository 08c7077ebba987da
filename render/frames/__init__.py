"""What a rendered frame holds: its pictures and the ground truth of them.

- frame: `Pictures`, `HandTruth`, `BodyTruth` and `RenderedFrame`.
"""
