"""Training labels from motion: background difference, blobs, three-frame links, boxes."""
