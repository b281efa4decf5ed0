"""Layers over images: convolutions and pooling."""
