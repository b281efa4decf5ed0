"""``--to torch``: writes a net as the source of a PyTorch module, with its weights in a file next to it.

The source looks like handwritten code. Submodules have the names of the layers. Only the line that gives the
origin mentions this project. The module computes the same as the net.
"""

from __future__ import annotations

import inspect
import json
import re
import textwrap
from collections.abc import Mapping
from pathlib import Path

import torch

from netspec.errors import SpecError
from netspec.export.formats.shapes import NetShapes, input_shapes, settled
from netspec.export.formats.torch_code import (
    MARK,
    WIDTH,
    Definition,
    Module,
    check_shapes,
    class_name,
    lay_out,
    legal,
    number,
    quoted,
    unique,
    write_definition,
)
from netspec.export.table import layer_notes
from netspec.files.whole_file import whole_file
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
    """Write tensors as a .safetensors file, with the same bytes each time.

    The library writes metadata in the order of a hash table, which differs from process to process.
    """
    from safetensors.torch import save

    data = memoryview(save(dict(state), dict(metadata)))
    end = 8 + int.from_bytes(data[:8], "little")
    header = json.loads(bytes(data[8:end]))
    if "__metadata__" in header:
        header = {"__metadata__": dict(sorted(header.pop("__metadata__").items())), **header}
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # tensors begin at a multiple of 8
    with whole_file(path) as unfinished, unfinished.open("wb") as file:
        for part in (len(text).to_bytes(8, "little"), text, data[end:]):
            file.write(part)


def torch_source(net: Net, origin: str = "a prototxt") -> tuple[str, dict[str, torch.Tensor], list[str]]:
    """Return a net as PyTorch source, the state_dict of its class, and notes for the user, as lines."""
    definition, shapes = settled(net, lambda shapes: write_definition(net, shapes))
    attributes = definition.attributes()
    body = _parts(net, definition, attributes, shapes)
    header = " ".join(f"{net.name or 'A net'}, converted from {origin}".split())
    header = header if len(header) < WIDTH - 8 else header[: WIDTH - 12] + "..."
    imports = [
        *(["import math"] if "math." in body else []),
        "from pathlib import Path",
        "",
        "import torch",
        *(["import torch.nn.functional as F"] if re.search(r"\bF\.", body) else []),
        "from safetensors.torch import load_file",
        "from torch import nn",
    ]
    text = "\n".join([f'""{quoted(f"{header}.")}""', "", *imports, "", "", body, ""])
    state: dict[str, torch.Tensor] = {}
    for m, attribute in attributes.items():
        state.update(definition.modules[m].tensors(attribute))
    return text, state, [*shapes.fixed, *layer_notes(net.layers)]


def _parts(net: Net, definition: Definition, attributes: Mapping[int, str], shapes: NetShapes) -> str:
    """Return the file below its imports: functions, the class, and code that loads and runs it."""
    name, expected = class_name(net.name or "net"), input_shapes(net, shapes)
    if expected:
        definition.functions[check_shapes.__name__] = check_shapes
    taken = set(definition.functions)
    inputs = {v: unique(legal(definition.names[v], "blob_"), taken) for v in definition.inputs}
    takes = ", ".join(f"{definition.names[v]} {_shape(shapes, v)}" for v in inputs)
    gives = ", ".join(f"{blob} {_shape(shapes, v)}" for blob, v in net.plan.outputs.items())
    example = ", ".join(f"torch.zeros({', '.join(map(str, shapes.built[v]))})" for v in inputs)
    head = f"    def forward(self, {', '.join(inputs.values())}):"
    if len(head) > WIDTH:
        head = (
            "\n        ".join(["    def forward(", "self,", *(f"{given}," for given in inputs.values())]) + "\n    ):"
        )
    lines = [f"class {name}(nn.Module):", *_docstring(f"{takes} -> {gives}."), ""]
    if expected:
        lines += ["    expected = {", *(f"        {quoted(b)}: {number(s)}," for b, s in expected.items()), "    }", ""]
    if attributes:
        lines += ["    def __init__(self):", "        super().__init__()"]
        for m, attribute in attributes.items():
            lines += lay_out(_constructed(definition.modules[m], attribute), 8)
        lines += [""]
    lines.append(head)
    if expected:
        lines += lay_out(f"check_shapes(self.expected, {', '.join(inputs.values())})", 8)
    lines += _forward(definition, inputs, attributes)
    load = [
        'def load(weights=Path(__file__).with_suffix(".safetensors")):',
        '    """Return the net with its trained weights, for inference."""',
        f"    net = {name}()",
        "    net.load_state_dict(load_file(weights))",
        "    return net.eval()",
    ]
    main = ['if __name__ == "__main__":', *lay_out(f"outputs = load()({example})", 4)]
    if len(definition.outputs) > 1:
        main += ["    for name, output in outputs.items():", "        print(name, tuple(output.shape))"]
    else:
        main += lay_out(f"print({quoted(next(iter(definition.outputs), ''))}, tuple(outputs.shape))", 4)
    functions = [textwrap.dedent(inspect.getsource(each)).strip() for each in definition.functions.values()]
    return "\n\n\n".join([*functions, *("\n".join(part) for part in (lines, load, main))])


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


def _constructed(module: Module, attribute: str) -> str:
    call = module.constructor()
    if module.kind == "buffer":
        return f'self.register_buffer("{attribute}", {call})'
    return f"self.{attribute} = {call}"


def _forward(definition: Definition, inputs: Mapping[int, str], attributes: Mapping[int, str]) -> list[str]:
    """Return the statements of the forward method, as lines.

    A value that only the next statement reads is named ``x``, so that its memory is freed. Others have the name
    of their blob.
    """
    names, statements = dict(inputs), definition.statements
    readers: dict[int, list[int]] = {}
    for i, statement in enumerate(statements):
        for v in statement.values():
            readers.setdefault(v, []).append(i)
    for v in definition.outputs.values():
        readers.setdefault(v, []).append(len(statements))
    holder = {name: v for v, name in inputs.items()}

    def free(name: str, i: int) -> bool:
        return name not in holder or max(readers.get(holder[name], [-1])) <= i

    lines: list[str] = []
    for i, statement in enumerate(statements):
        expression = MARK.sub(
            lambda m: names[int(m[2])] if m[1] == "v" else f"self.{attributes[int(m[2])]}", statement.expression
        )
        for v in statement.targets:
            wanted = legal(definition.names[v], "blob_")
            wanted = f"{wanted}_" if wanted in definition.functions else wanted
            passed = set(readers.get(v, [])) == {i + 1}
            candidates = [*("x", "y")[: 2 * passed], wanted, *(f"{wanted}_{k}" for k in range(2, 1000))]
            names[v] = next(name for name in candidates if free(name, i)) if v in readers else "_"
            holder[names[v]] = v
        lines += lay_out(f"{', '.join(names[v] for v in statement.targets)} = {expression}", 8)
    if len(definition.outputs) == 1:
        return [*lines, f"        return {names[next(iter(definition.outputs.values()))]}"]
    pairs = [f"            {quoted(name)}: {names[v]}," for name, v in definition.outputs.items()]
    return [*lines, "        return {", *pairs, "        }"]
