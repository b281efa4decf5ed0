"""Blobs of a net as files: over records, over images, for a loop-closure detector."""
