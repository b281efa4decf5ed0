"""What an editor asks of a prototxt: faults, what stands at a place, who makes a blob, what may be written."""
