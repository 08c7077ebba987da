"""Noise of sensors on perfect pictures.

- random_images: fields of random numbers in a picture's size.
- structured_light: depth noise of Kinect v1 and RealSense D435.
- time_of_flight: depth noise of Kinect v2 and Azure Kinect.
- depth_noise: the depth sensors by name.
- shutter: motion blur and rolling shutters.
- exposure: exposure, white balance, shot and read noise, JPEG.
"""
