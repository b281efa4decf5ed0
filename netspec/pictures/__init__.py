"""Pictures of trainings, weights, blobs and data. The only room of netspec that loads matplotlib; nothing is computed.

Figures are made without pyplot, which would choose a backend for the whole program. Names from files are drawn as they
are (``parse_math=False``): a dollar sign in them does not begin a formula.
"""
