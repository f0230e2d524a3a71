"""Counts and signals of the junctions for traffic engineers' software."""
