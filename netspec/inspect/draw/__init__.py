"""Drawings of nets, of what they have learned, of trainings and of data.

For nets, the modules diagram and blocks determine what is drawn, dot writes a graph for Graphviz, graphviz runs
Graphviz, and page makes an HTML page. All other drawings are figures of matplotlib. They do not use pyplot, which would
choose a backend for the whole program. Names from files are drawn unchanged (``parse_math=False``): a dollar sign in
them does not begin a formula.
"""
