"""Descriptors of images: the files they come in, how alike two are, whitening."""
