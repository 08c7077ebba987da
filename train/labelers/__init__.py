"""Labelers: networks that give every point of a frame its marker, and what turns their scores into labels.

- protocol: what every labeler offers (`Labeler`, `Labeling`), checks of its input, batches.
- kinds: the table of networks: how each is built, its loss, and how it becomes a labeler.
- storage: trained labelers on disk, shipped or a user's; loading and saving them.
- set_network, set_labeler: the default network, on pairwise distances; the labeler around it.
- depth_image, cnn_network, cnn_labeler: the depth images and the network of Han et al. 2018; its labeler.
- onnx_labeler: the set labeler as one ONNX file, run without torch.
- matching: from scores to a one-to-one labeling with a reject option.
- side: left or right hand, from labeled points.
"""
