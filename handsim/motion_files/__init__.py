"""Files of hands in motion for other programs; nothing here reads them.

- motion: `Motion`, what every format is written from; a `gloves.Take` is one
- local_poses: rotations of the bones relative to their parents
- mesh_normals: normals of objects that keep their edges
- glb_buffer: the binary container of glTF
- glb_animation: skinned and animated hands and things, for game engines and 3D programs
- bvh: skeletons in motion, for animation programs
- usd: skinned and animated hands and things, for film and robot pipelines
- joint_table: joint angles and positions as a table, .csv and .parquet
- opensim_motion: joint angles as OpenSim's .mot
- openxr: the 26 joints of OpenXR's hand tracking
"""
