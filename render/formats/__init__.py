"""File formats of rendered frames.

- png_depth: pictures as PNG and JPEG bytes; depth as 16-bit PNG with its unit.
- exr: all pictures of a frame in one OpenEXR file.
- shards: shards on disk, tars or folders, each written as a whole.
- folder_writers: the formats png, exr, coco, yolo and interhand.
- clip_writer: the format webdataset, clips in tars.
- freihand_writer: the format freihand.
- writer: the writers by name of their format.
- merging: several renderings copied into one.
- annotations/: ground truth in the JSON of other data sets.
"""
