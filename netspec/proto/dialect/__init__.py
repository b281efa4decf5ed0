"""The dialects of Caffe's forks as additions to the schema."""
