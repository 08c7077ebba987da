"""What is around the hands: backgrounds and light.

- rooms: ray-cast pictures of random rooms.
- photographs: a user's own photographs.
- backdrops: walls and tables close behind the hands, which catch their shadows.
- backgrounds: plain, gradient, noise, clutter, room and photograph.
- enclosures: backgrounds with depth, for several cameras.
- lights: lamps and ambient light.
- surroundings: a background together with light that has its colors.
"""
