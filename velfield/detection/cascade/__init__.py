"""The boosted cascade (after Viola and Jones): region proposals, then a classifier of rotated crops."""
