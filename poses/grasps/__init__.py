"""A hand that holds an object.

- grasp_scene: hand and object in one MuJoCo scene, and their overlap
- retargeting: joint angles of the mean hand brought to another
- hold_library: named ways to hold objects
- grasping: grasps settled by dynamics
- held_poses: valid variants of a grasp
- object_motion: smooth motion between them
"""
