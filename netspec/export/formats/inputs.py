"""What the inputs of an exported net must look like: one rule for exported source and torch.export.

An expected shape has a number for each size that is fixed and a name for each that is free. Names are equal where the
sizes must be.
"""


def check_shapes(found, expected):
    """Refuse inputs of other shapes; a name is any size, the same wherever it stands."""
    sizes = {}
    for name, shape in expected.items():
        for size, wanted in zip(found[name], shape, strict=False):
            if isinstance(wanted, str):
                sizes.setdefault(wanted, size)
        shape = tuple(sizes.get(wanted, wanted) for wanted in shape)
        if tuple(found[name]) != shape:
            raise ValueError(f"{name} has shape {tuple(found[name])}, expected {shape}")
