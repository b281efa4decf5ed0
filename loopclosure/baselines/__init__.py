"""The baselines that a learned descriptor has to beat: bag of words, FAB-MAP, grey thumbnails."""
