"""Text recognition: sequences of characters, CTC."""
