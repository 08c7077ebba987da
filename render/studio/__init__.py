"""One frame of a take, seen by one camera: pictures with ground truth.

- hand_truth: what is known of a hand in a picture, computed from its pose and its id picture.
- studio: `Studio`, which draws a frame through lens, shutter and sensors.
"""
