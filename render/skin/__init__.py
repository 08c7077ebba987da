"""The skin of a drawn hand: its mesh on a forearm, and the texture on it.

- forearm: the arm behind the wrist.
- atlas: connectivity and texture coordinates of the mesh, the same for every hand.
- flexion: what joints make of the skin around them.
- mesh: the posed mesh with normals, ambient shade and parts.
- fields: smooth functions that textures are painted with.
- texels: the anatomy at each texel, with palm lines, finger creases and knuckle wrinkles.
- relief: fine relief as a normal map.
- look: a person's skin in plain values, and its distribution.
- texture: the painted skin.
- glove_look: the cloth of a marker glove over it.
"""
