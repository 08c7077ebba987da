"""What is around the hands: backgrounds and light.

- rooms: ray-cast pictures of random rooms.
- photographs: a user's own photographs.
- backgrounds: plain, gradient, noise, clutter, room and photograph, and the backdrops that catch shadows.
- enclosures: backgrounds with depth, for several cameras.
- lights: lamps and ambient light, and a background together with light that has its colors.
"""
