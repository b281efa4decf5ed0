"""Pictures of nets, of what they have learned, of trainings and of data.

Of nets: what is drawn (diagram, blocks), as a graph in the language of Graphviz (dot), which lays it out and draws it
(graphviz), or as a page (page). The others are figures of matplotlib without pyplot, which would choose a backend for
the whole program. Names from files are drawn as they are (``parse_math=False``): a dollar sign in them does not begin
a formula.
"""
