"""Advice on camera rigs, before they are hung: what is suspicious, what they will miss, a better rig."""
