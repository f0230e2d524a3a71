"""Video files: probing, decoding with true timestamps, detection of corruption."""
