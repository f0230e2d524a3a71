"""Registration: frames to the base image (intra-sensor), the base image to another sensor's picture (inter-sensor)."""
