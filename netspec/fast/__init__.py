"""Speed: what makes nets faster and changes nothing of what they compute. Without this folder they run all the same."""
