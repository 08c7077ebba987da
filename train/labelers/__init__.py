"""Labelers: networks that give every point of a frame its marker, and what turns their scores into labels.

- protocol: what every labeler offers (`Labeler`, `Labeling`), checks of its input, batches; a user's own.
- kinds: the table of networks: how each is built, its loss, and how it becomes a labeler.
- storage: trained labelers on disk, shipped or a user's; loading and saving them.
- set_network, set_labeler: the default network, on pairwise distances; the labeler around it.
- batch_network: a network for batches, on a GPU where there is one.
- set_inference: that network on one cloud in numpy.
- views, depth_image: from where the network of Han et al. 2018 sees a cloud, and what it sees.
- cnn_network, sparse_convolution, cnn_labeler: that network, its first filters, the labeler around it.
- onnx_labeler: a labeler as one ONNX file, run without torch.
- side: left or right hand, from labeled points.
"""
