"""From surfaces and lamps to colors, depth and ids.

- materials: how surfaces reflect light.
- figures: hands, rigid bodies and balls as surfaces with materials.
- rasterizer: depth, normals and ids of triangles by a compiled z-buffer.
- shadows: of a lamp, by its z-buffer, on the hands and on what is close behind them.
- shading: the microfacet model of a surface point.
- compiled_painter: colors by the compiled z-buffer and shading.
- gl: the import of pyrender, one off-screen renderer per process, and whether it draws on hardware.
- opengl_painter: colors by OpenGL.
- painter: the choice between the two painters, and pictures over backgrounds.
"""
