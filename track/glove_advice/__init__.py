"""Advice on marker layouts: how well one can be labeled, what it tells of each joint, and a better one.

- observed_hands: gloved hands in many poses, or in a take's motion, as a rig and its optical system see them.
- joint_spread: what the seen markers leave open of each joint, by the solver's information matrix.
- layout_score: everything that is known of a layout: labels, markers, joints, near pairs, sides.
- advice: sentences: move this, add that, drop this.
- score_page, joint_picture: the page of a score, and its hand with joints colored by uncertainty.
- worn_places: places on the skin of fixed people in fixed poses, from which layouts are put together.
- layout_worth: how good a layout is, quickly, so that many can be compared.
- improvement: a search for a better layout near a given one.
"""
