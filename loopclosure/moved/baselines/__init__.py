"""Former name of loopclosure.methods and loopclosure.words."""
