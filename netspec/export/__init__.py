"""Export of nets to other formats, and to other engines."""
