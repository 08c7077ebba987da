"""The skin: a smooth closed mesh that is a function of the shape.

- cage_topology: vertices and faces of the control cage
- cage: the cage in space for a shape
- subdivision: Catmull-Clark as one sparse matrix
- weights: skinning weights on the cage
- surface: the fitted skin, vertex normals, linear blend skinning
- skinning: the same skinning, compiled, for many frames
"""
