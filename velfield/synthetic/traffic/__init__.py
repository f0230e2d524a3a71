"""The simulated traffic: vehicles and how they drive."""
