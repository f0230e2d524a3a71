"""Registration to a base image of another sensor, such as an orthophoto or a thermal image."""
