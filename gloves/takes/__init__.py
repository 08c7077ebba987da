"""Takes: hands over time, what was seen of them and their labels, simulated, tracked or a user's own.

- take: `Take`, and how it is saved and loaded
- columns: the one table of its arrays
- archives: named arrays and a JSON header in one .npz
- growing: the same while it is recorded, safe however the recording ends
- corrections: labels that a person corrected, beside a tracked take
- formats: the files that other programs read
"""
