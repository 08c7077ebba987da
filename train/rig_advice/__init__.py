"""Advice on camera rigs, before they are hung: what is suspicious, what they will miss, a better rig.

- rig_faults: what is suspicious about a rig, without any simulation.
- work: hands at work, simulated or of a take, wherever in the volume they go.
- forecast: what captures of them will miss, what each camera is worth, and the error of points.
- volume_map: what is seen of hands at each point of a volume.
- rig_score: all of these, and what to do about it.
- rig_page: the page of a score.
- mounts: where cameras can hang and look in a room.
- planning: what a camera at each of these places would see, and the search among them.
- plan: a planned rig and its forecast.
"""
