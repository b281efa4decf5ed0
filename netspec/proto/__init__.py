"""The language: Caffe's schema, its text and binary forms, and the upgrades from its older dialects. No torch, no numpy."""
