"""Ways to look at nets, trainings and their files without changing them."""
