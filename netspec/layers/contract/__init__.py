"""What a layer is, and what it may offer besides: the base class, the registry, and one page for each offer."""
