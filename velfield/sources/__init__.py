"""What comes in: video and image folders with true times, labels, external detections, base images."""
