"""Advice on camera rigs, before they are hung: what is suspicious, what they will miss, a better rig.

- rig_faults: what is suspicious about a rig, without any simulation.
- work: hands at work, simulated or of a take, wherever in the volume they go.
- forecast: what captures of them will miss, and what each camera is worth.
- point_error: the error of triangulated points as an ellipsoid.
- volume_map: what is seen of hands at each point of a volume.
- rig_score: all of these; rig_sentences: what to do about it.
- rig_page, rig_picture: the page of a score and its pictures.
- mounts: where cameras can hang and look in a room.
- candidate_views: what a camera at each of these places would see, once for all.
- planning: the search among them; plan: a planned rig and its forecast.
"""
