"""Visual words: vocabulary, bag of words, VLAD and FAB-MAP."""
