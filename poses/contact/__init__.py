"""Two hands, and a hand beside an object in the other.

- interactions: the library of interactions, and random meetings drawn from it
- contact_search: compiled searches for contact
- contact_closing: hands brought together and fingers closed until they touch
- passages: frames of two hands, their validity, paths between them
- meetings: one meeting played out, or single poses of many
- two_hands: whole motions and single poses of two hands
- pointing: paths of a pen that points at markers
- keeping_apart: a hand with an object drawn back where it would touch
"""
