"""Runs programs written for pycaffe: lets them import it, restores old names, and translates Python 2.

Nothing here needs torch or numpy before the program itself asks for them.
"""
