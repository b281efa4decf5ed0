"""Blobs of a net for records, for images, and for a loop-closure detector."""
