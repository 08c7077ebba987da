"""Calibrations of cameras as other programs write them, one file per format.

- any_file: the cameras of a file of any kind, by its ending and its content; those that see markers
- lab_camera: `LabCamera`, a camera of a calibration, and the values that all formats have
- vicon_xcp: Vicon's `.xcp`
- qualisys_calibration: the calibration that QTM exports, or that its real-time server sends
- motive_mcal: OptiTrack Motive's `.mcal`
- opencv_file: OpenCV's YAML and JSON: one camera, a stereo pair or many
- colmap_file: COLMAP's reconstructions as text
- xml_tree: XML without entities, of bounded size
"""
