"""Commands of this package, one per file.

- hand: `handsim hand`, a hand as a MuJoCo model and as a mesh.
"""
