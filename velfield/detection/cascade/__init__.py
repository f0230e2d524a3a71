"""The boosted cascade: proposals, then a classifier on crops turned to the horizontal."""
