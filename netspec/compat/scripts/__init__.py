"""Programs that were written for pycaffe: how they find it, old names and old Python in them, and how they are run.

Nothing here needs torch or numpy before the program itself asks for them.
"""
