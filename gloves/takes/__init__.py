"""Takes: whole recordings with their truth or their tracked motion.

- archives: named arrays and a JSON header in one .npz
- growing: the same while it is recorded, safe however the recording ends
- take: `Take`, a simulated capture and its truth
- tracked_take: `TrackedTake`, the output of a tracker
- corrections: labels that a person corrected, beside a tracked take
- motion: the motion in either, for other programs
"""
