"""Images resampled in numba, where OpenCV takes a pass for every step."""
