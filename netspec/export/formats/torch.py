"""``--to torch``: writes a net as the source of a PyTorch module, with its weights in a file next to it.

The source looks like handwritten code. Submodules have the names of the layers. Only the line that gives the
origin mentions this project. The module computes the same as the net.
"""

from __future__ import annotations

import itertools
import json
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from netspec.errors import SpecError
from netspec.export.exporter import layer_notes
from netspec.export.expression import Call, Stored, Submodule, Value, parts
from netspec.export.formats.shapes import NetShapes, check_shapes, input_shapes, settled
from netspec.export.formats.source import (
    WIDTH,
    Parts,
    Printed,
    Source,
    class_name,
    copied,
    lay_out,
    legal,
    quoted,
    source_of,
    text_of,
    unique,
)
from netspec.export.formats.torch_code import Definition, write_definition
from netspec.files.whole_file import whole_file
from netspec.layers.contract.learned import values_of
from netspec.net.net import Net


def export_torch(net: Net, path: str | Path, origin: str = "a prototxt") -> list[str]:
    """Write a net as PyTorch source, and its weights to a ``.safetensors`` file next to it; return notes for the user.

    ``origin`` is the text about its origin. Raises SpecError if a layer cannot be exported or a file not written.
    """
    path = Path(path)
    if path.suffix != ".py":
        raise SpecError(f"--out {path}: expected a name that ends in .py")
    text, state, notes = torch_source(net, origin)
    weights = path.with_suffix(".safetensors")
    with whole_file(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
        write_tensors(state, weights, {"format": "pt", "source": origin})
    return [*notes, f"the weights are in {weights.name}, next to the module"]


def write_tensors(state: Mapping[str, torch.Tensor], path: Path, metadata: Mapping[str, str]) -> None:
    """Write float32 tensors as a .safetensors file, one by one, so that their memory is not needed twice.

    The file has the length of its header, the header as JSON, and the numbers.
    """
    header: dict[str, Any] = {"__metadata__": dict(sorted(metadata.items()))}
    end = 0
    for name, tensor in sorted(state.items()):
        begin, end = end, end + 4 * tensor.numel()
        header[name] = {"dtype": "F32", "shape": list(tensor.shape), "data_offsets": [begin, end]}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # tensors begin at a multiple of 8
    with whole_file(path) as unfinished, unfinished.open("wb") as file:
        file.write(len(text).to_bytes(8, "little") + text)
        for _, tensor in sorted(state.items()):
            file.write(values_of(tensor).cpu().float().reshape(-1).numpy().data)


def torch_source(net: Net, origin: str = "a prototxt") -> tuple[str, dict[str, torch.Tensor], list[str]]:
    """Return a net as PyTorch source, the state_dict of its class, and notes for the user, as lines."""
    definition, shapes = settled(net, lambda shapes: write_definition(net, shapes))
    body = _parts(net, definition, shapes)
    header = " ".join(f"{net.name or 'A net'}, converted from {origin}".split())
    header = header if len(header) < WIDTH - 8 else header[: WIDTH - 12] + "..."
    imports = [
        "from pathlib import Path",
        "",
        "import torch",
        *(["import torch.nn.functional as F"] if re.search(r"\bF\.", body) else []),
        "from safetensors.torch import load_file",
        "from torch import nn",
    ]
    text = "\n".join([f'""{quoted(f"{header}.")}""', "", *imports, "", "", body, ""])
    return text, definition.state(), [*shapes.fixed, *layer_notes(net.layers)]


def _parts(net: Net, definition: Definition, shapes: NetShapes) -> str:
    """Return the file below its imports: functions, the class, and code that loads and runs it."""
    name, expected = class_name(net.name or "net"), input_shapes(net, shapes)
    source = Source({stored: f"self.{attribute}" for stored, attribute in definition.attributes.items()})
    functions = copied(part for _, expression in definition.statements for part in parts(expression))
    if expected:
        functions[check_shapes.__name__] = check_shapes
    taken = set(functions)
    inputs = {v: unique(legal(definition.blobs[v], "blob_"), taken) for v in definition.inputs}
    takes = ", ".join(f"{definition.blobs[v]} {_shape(shapes, v)}" for v in inputs)
    gives = ", ".join(f"{blob} {_shape(shapes, v)}" for blob, v in net.plan.outputs.items())
    example: Printed = source.arguments([Call(torch.zeros, shapes.built[v], {}) for v in inputs], {})
    head = f"    def forward(self, {', '.join(inputs.values())}):"
    if len(head) > WIDTH:
        head = "\n        ".join(["    def forward(", "self,", *(f"{each}," for each in inputs.values())]) + "\n    ):"
    lines = [f"class {name}(nn.Module):", *_docstring(f"{takes} -> {gives}."), ""]
    if expected:
        sizes = [f"        {quoted(blob)}: {text_of(source.of(shape))}," for blob, shape in expected.items()]
        lines += ["    expected = {", *sizes, "    }", ""]
    if definition.attributes:
        lines += ["    def __init__(self):", "        super().__init__()"]
        made = [_made(source, stored, attribute) for stored, attribute in definition.attributes.items()]
        lines += itertools.chain(*made)
        lines += [""]
    lines.append(head)
    if expected:
        lines += lay_out(["check_shapes(", Parts([["self.expected"], *([each] for each in inputs.values())]), ")"], 8)
    lines += _forward(definition, source, inputs, set(functions))
    load = [
        'def load(weights=Path(__file__).with_suffix(".safetensors")):',
        '    """Return the net with its trained weights, for inference."""',
        f"    net = {name}()",
        "    net.load_state_dict(load_file(weights))",
        "    return net.eval()",
    ]
    main = ['if __name__ == "__main__":', *lay_out(["outputs = load()", *example], 4)]
    if len(definition.outputs) > 1:
        main += ["    for name, output in outputs.items():", "        print(name, tuple(output.shape))"]
    else:
        shown = Parts([[quoted(next(iter(definition.outputs), ""))], ["tuple(outputs.shape)"]])
        main += lay_out(["print(", shown, ")"], 4)
    return "\n\n\n".join([*map(source_of, functions.values()), *("\n".join(part) for part in (lines, load, main))])


def _shape(shapes: NetShapes, value: int) -> str:
    shown = [
        str(size) if size is not None else shapes.name(value, axis) for axis, size in enumerate(shapes.sizes(value))
    ]
    return f"({', '.join(shown)}{',' if len(shown) == 1 else ''})"


def _docstring(text: str) -> list[str]:
    text = quoted(text)[1:-1]
    if len(text) + 10 <= WIDTH:
        return [f'    """{text}"""']
    wrapped = textwrap.wrap(text, WIDTH - 4, break_long_words=False)  # which could split an escape sequence
    return ['    """Inputs and outputs.', "", *(f"    {line}" for line in wrapped), '    """']


def _made(source: Source, stored: Stored | Submodule, attribute: str) -> list[str]:
    """Return the statement that makes a submodule, a parameter or a buffer, as lines."""
    if isinstance(stored, Submodule):
        return lay_out([f"self.{attribute} = ", *source.constructor(stored)], 8)
    zeros = source.of(Call(torch.zeros, (tuple(stored.values.shape),), {}))
    if stored.learned:
        return lay_out([f"self.{attribute} = nn.Parameter(", Parts([zeros]), ")"], 8)
    return lay_out(["self.register_buffer(", Parts([[quoted(attribute)], zeros]), ")"], 8)


def _forward(definition: Definition, source: Source, inputs: Mapping[int, str], taken: set[str]) -> list[str]:
    """Return the statements of the forward method, as lines.

    A value that only the next statement reads is named ``x``, so that its memory is freed. Others have the name
    of their blob.
    """
    statements, names = definition.statements, source.names
    names.update({definition.values[v]: name for v, name in inputs.items()})
    readers: dict[int, list[int]] = {}
    for i, (_, expression) in enumerate(statements):
        for part in parts(expression):
            if isinstance(part, Value):
                readers.setdefault(part.number, []).append(i)
    for v in definition.outputs.values():
        readers.setdefault(v, []).append(len(statements))
    holder = {name: v for v, name in inputs.items()}

    def free(name: str, i: int) -> bool:
        return name not in holder or max(readers.get(holder[name], [-1])) <= i

    lines: list[str] = []
    for i, (targets, expression) in enumerate(statements):
        printed = source.of(expression)
        made = []
        for v in targets:
            wanted = legal(definition.blobs[v], "blob_")
            wanted = f"{wanted}_" if wanted in taken else wanted
            passed = set(readers.get(v, [])) == {i + 1}
            candidates = [*("x", "y")[: 2 * passed], wanted, *(f"{wanted}_{k}" for k in range(2, 1000))]
            made.append(next(name for name in candidates if free(name, i)) if v in readers else "_")
            names[definition.values[v]] = made[-1]
            holder[made[-1]] = v
        lines += lay_out([f"{', '.join(made)} = ", *printed], 8)
    outputs = {name: names[definition.values[v]] for name, v in definition.outputs.items()}
    if len(outputs) == 1:
        return [*lines, f"        return {next(iter(outputs.values()))}"]
    return [*lines, "        return {", *(f"            {quoted(n)}: {x}," for n, x in outputs.items()), "        }"]
