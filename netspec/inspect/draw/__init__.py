"""Pictures of nets, of what they have learned, of trainings and of data.

Nets: the modules diagram and blocks work out what is drawn, dot writes it as a graph for Graphviz, graphviz runs
Graphviz, and page makes an HTML page. All other pictures are figures of matplotlib. They do not use pyplot, which would
choose a backend for the whole program. Names from files are drawn unchanged (``parse_math=False``): a dollar sign in
them does not begin a formula.
"""
