"""The language: Caffe's schema, its text and binary forms, the upgrades from older forms. No torch, no numpy."""
