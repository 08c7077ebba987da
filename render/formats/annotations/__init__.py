"""Ground truth of rendered frames in the JSON of other data sets.

- joint_orders: joint orders of other data sets, to and from our 21 keypoints.
- common: helpers that all annotations share (masks, boxes, rounding, JSON).
- hands_json: our own JSON of a frame, and that of clips, with our hand as a UmeTrack hand model.
- coco, yolo, interhand: the annotations of these data sets.
"""
