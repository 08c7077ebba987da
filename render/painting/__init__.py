"""From surfaces and lamps to colors, depth and ids.

- materials: how surfaces reflect light.
- spheres: many spheres as one surface.
- figures: hands and rigid bodies as surfaces with materials.
- rasterizer: depth, normals and ids of triangles by a compiled z-buffer.
- shadow_map: a lamp's z-buffer.
- cast_shadow: shadows on what is close behind the hands.
- shading: the microfacet model of a surface point.
- compiled_painter: colors by the compiled z-buffer and shading.
- gl: the import of pyrender, and one off-screen renderer per process.
- opengl_lights: the lamps of a picture in a pyrender scene.
- opengl_painter: colors by OpenGL.
- hardware: whether OpenGL draws on graphics hardware here.
- painter: the choice between the two painters, and pictures over backgrounds.
"""
