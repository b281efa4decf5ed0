"""Visual words: vocabulary, bag of words and FAB-MAP."""
