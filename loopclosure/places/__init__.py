"""Where images were taken, which show the same place, and the data sets that say so."""
