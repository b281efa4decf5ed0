"""Descriptors of images: their files, their similarity, whitening."""
