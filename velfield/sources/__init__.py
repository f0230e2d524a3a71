"""Inputs: video and image folders with true times, labels, external detections, base images."""
