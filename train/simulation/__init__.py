"""Simulated captures and training sets.

A take flows from `scenes` (people in gloves, and their motion) through `room` (light sources, cameras and the
optical system) to `takes`. Rows of training sets are single frames (`training_frames`), which `generation`
writes in shards.
"""
