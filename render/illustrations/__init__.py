"""Ready-made pictures for pages, drawn without OpenGL.

- palette: colors of paper, digits, skin, gloves and points.
- scene: the scene of a picture: posed hands, balls and the view of them; its colors and depth.
- captions: names with leader lines, titles, pictures side by side, PNG files.
- hands: sizes, gestures, gloves, camera views and labeled frames of hands.
- clip: a video of hands and points in one view.
- contact_sheet: rendered frames on one sheet, with keypoints and colored depth.
"""
