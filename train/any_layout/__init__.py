"""A labeler for any layout, without a training set: one network that takes the layout as an input.

- layout_network: the network; points are compared with the distances that a layout's markers have.
- worn_markers: a layout's markers on many people in many poses, from which it is known.
- layout_labeler: the labeler around the network, for one layout; the shipped weights.
- fine_tuning: a minute of training of that network on one layout.
- learned_gloves: what was learned, kept in the user's cache folder.
- skin_bank: many places on the skin in many poses, of which random layouts are made.
- layout_training: how the shipped weights were trained.
"""
