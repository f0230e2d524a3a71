"""The field and the tracklets for geographic information systems."""
