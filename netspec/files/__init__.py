"""Files: they are written completely or not at all, and read within limits. Both netspec and loopclosure use it."""
