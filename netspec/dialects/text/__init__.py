"""Reading text: sequences of characters, CTC."""
