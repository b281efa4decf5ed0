"""The base class of layers, the registry, and one module for each optional feature of a layer."""
