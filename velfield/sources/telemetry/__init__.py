"""Where the camera was, how high, and which way it looked, by the metadata that a drone writes."""
