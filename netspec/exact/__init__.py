"""Caffe's arithmetic to the last bit: BLAS' sums in BLAS' order, and the C library's functions."""
