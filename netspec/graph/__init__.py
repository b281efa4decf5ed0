"""The passes between a parsed net and a runnable net: NetParameter in, NetParameter or Plan out; nothing is mutated.

Every error goes to ``source.report``, which raises the first one by default. With a map that collects errors
(``SourceMap.telling``), a caller gets all of them, and a result in which the wrong parts are unchanged.
"""
