"""What an optical system sees of markers.

- visibility: lines of sight past capsules, facing, field of view
- mesh_tree: bounding-volume tree over a moving mesh
- mesh_lines: compiled search of that tree
- mesh_sight: lines of sight past meshes
- mirrors: mirror images in shiny patches
- strays: stray reflections that persist
- ghosts: ghosts of single frames for training sets
- blobs: blobs in the pictures of single cameras
- triangulation: points from rays, and false intersections
- reconstruction: an optical system's points, gaps and false points
- identities: marker IDs, new after every gap
"""
