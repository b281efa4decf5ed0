"""Pictures of nets, of what they have learned, of trainings and of data.

Of nets: what is drawn (diagram, blocks), where (layout, picture), and in which format (svg, html, png). The others are
figures of matplotlib without pyplot, which would choose a backend for the whole program. Names from files are drawn as
they are (``parse_math=False``): a dollar sign in them does not begin a formula.
"""
