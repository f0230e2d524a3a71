"""Labels and detections of other programs: the formats, their classes, frames and shapes."""
