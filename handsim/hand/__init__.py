"""One hand: from a person's measures to bones, flesh and skin in motion.

- topology: the ordered list of bones and joints
- shape: a person's measures, named sizes and a population
- skeleton: bones and joint axes at zero angles
- capsules: flesh as capsules
- skin/: the skin as a mesh with weights
- mjcf: the hand as a MuJoCo model
- urdf: the hand as a URDF robot
- kinematics: `T_world_bone` of many poses
- model: `HandModel`, which joins all of these
- keypoints: the 21 keypoints of a hand, their names and their skeleton
- jacobian: Jacobian of skinned points
- contact: overlap of a hand with itself and with another
- motion: `HandMotion` and `BodyMotion`, poses at a steady rate
- records: hand shapes as rows of arrays in files
"""
