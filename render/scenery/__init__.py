"""What is around the hands: backgrounds and light.

- rooms: ray-cast pictures of random rooms.
- photographs: photographs of the user's own.
- backgrounds: plain, gradient, noise, clutter, room and photograph.
- lights: lamps and ambient light.
- surroundings: a background together with light that has its colors.
"""
