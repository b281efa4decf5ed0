"""Caffe's schema, its text and binary formats, upgrades from older formats. No torch, no numpy in this package."""
