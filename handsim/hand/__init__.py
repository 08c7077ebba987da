"""One hand: from a person's measures to bones, flesh and skin in motion."""
