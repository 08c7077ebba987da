"""A labeler for any layout, without a training set: one network that takes the layout as an input."""
