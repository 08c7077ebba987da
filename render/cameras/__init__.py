"""The cameras of pictures: where they stand, and what their lenses do to a picture."""
