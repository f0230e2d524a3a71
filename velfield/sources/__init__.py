"""What comes in: video and picture folders with true times, labels, other people's detections, base pictures."""
