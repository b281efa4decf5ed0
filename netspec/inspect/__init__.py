"""Tools that inspect nets, trainings and their files without changing them."""
