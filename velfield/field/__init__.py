"""The velocity field: a histogram over velocity at every pixel of the map (paper: velocity model, velocity field)."""
