"""Files: written whole or not at all, read within limits. The ground of netspec and loopclosure."""
