"""Blobs of a net as files: for records, for images, for a loop-closure detector."""
