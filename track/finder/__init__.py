"""Hands in a capture: how many a frame holds, whose each point is, and which is left and right.

- measures: how far markers of a hand can be apart, and the check that labeled points fit a hand.
- links: points that are near each other, within a frame and from frame to frame.
- frame_hands: the hands of single frames, from clusters of points, their labels and that check.
- sides: left or right, from the frames in which a hand is followed.
- following: hands that are close to each other, followed from where they stand apart.
- voting: the labels along a point's path vote for the label in each frame.
- labeling: the hands of a capture with their labels, over all its frames.
"""
