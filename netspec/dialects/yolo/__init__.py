"""YOLO: detection on a grid."""
