"""Video files: probing, decoding with true timestamps, damage in the bitstream."""
