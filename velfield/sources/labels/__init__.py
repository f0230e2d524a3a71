"""Labels and boxes: CSV, YOLO, COCO, LabelMe, VIA, GeoJSON."""
