"""Ways for a net to leave: files of other formats, and other engines that run it."""
