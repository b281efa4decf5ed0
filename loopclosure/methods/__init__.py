"""What `--method` can name."""
