"""Single poses of one hand.

- library: named gestures
- couplings: what one joint's angle allows another
- samplers: random joint angles, inside ranges and couplings
- validity: which poses are valid, and the nearest valid ones
- sampling: `sample_poses`, with our sampler or the user's own
- touch: thumb and finger that touch
"""
