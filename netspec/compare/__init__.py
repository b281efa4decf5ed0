"""What differs between two nets, two solvers or two files of weights: by meaning, not by text. No torch."""
