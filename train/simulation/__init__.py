"""Simulated captures and training sets.

A take flows from `scenes` (people in gloves and what they do) through `room` (what shines, what cameras see,
what the optical system makes of it) to `takes`. Rows of training sets are single frames (`training_frames`),
which `generation` writes in shards.
"""
