"""A detector of another maker's: a YOLO-type network as an ONNX file, run on raw frames in tiles."""
