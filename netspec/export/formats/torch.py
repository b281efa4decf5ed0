"""``--to torch``: a net as the source of a PyTorch module, with its weights beside it.

The source reads as if a person had written it: submodules named after the layers, no trace of this
project but the line that says where it came from. It computes what the net computes.
"""

from __future__ import annotations

import inspect
import json
import re
import textwrap
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from netspec.errors import SpecError
from netspec.export.formats.inputs import check_shapes
from netspec.export.formats.shapes import NetShapes, input_shapes, settled
from netspec.export.formats.source import (
    WIDTH,
    Module,
    Program,
    Statement,
    class_name,
    lay_out,
    legal,
    mark,
    number,
    quoted,
    substitute,
    unique,
)
from netspec.export.formats.torch_code import write_program
from netspec.files.whole_file import whole_file
from netspec.net.net import Net

MOST_NESTED = 3  # calls within one another in a line


def export_torch(net: Net, path: str | Path, origin: str = "a prototxt") -> list[str]:
    """Write a net as PyTorch source, and its weights beside it in ``.safetensors``; return notes for its user.

    ``origin`` says in the source where it came from. Raises SpecError where a layer cannot be written, or a file.
    """
    path = Path(path)
    if path.suffix != ".py":
        raise SpecError(f"--out {path}: expected a name that ends in .py")
    text, state, notes = torch_source(net, origin)
    weights = path.with_suffix(".safetensors")
    with whole_file(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
        write_tensors(state, weights, {"format": "pt", "source": origin})
    return [*notes, f"the weights are in {weights.name}, beside the module"]


def write_tensors(state: Mapping[str, torch.Tensor], path: Path, metadata: Mapping[str, str]) -> None:
    """Write tensors as a .safetensors file, with the same bytes each time.

    The library writes metadata in the order of a hash table, another in each process.
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
    """Return a net as PyTorch source, the state_dict of the class in it, and notes for its user, in lines."""
    program, shapes = settled(net, lambda shapes: write_program(net, shapes))
    name = class_name(net.name or "net")
    attributes = program.attributes()
    expected = input_shapes(net, shapes)
    sizes = [f"{program.names[v]} {_shape(shapes, v)}" for v in program.inputs]
    made = [f"{blob} {_shape(shapes, v)}" for blob, v in net.plan.outputs.items()]
    if expected:
        program.functions[check_shapes.__name__] = check_shapes
    example = ", ".join(f"torch.zeros({', '.join(map(str, shapes.built[v]))})" for v in program.inputs)
    parts = [textwrap.dedent(inspect.getsource(function)).strip() for function in program.functions.values()]
    parts += [
        _net_class(program, name, attributes, f"{', '.join(sizes)} -> {', '.join(made)}", expected),
        _loader(name),
        _main(program, example),
    ]
    body = "\n\n\n".join(parts)
    text = f"{_header(net.name or 'A net', origin, body)}\n\n\n{body}\n"
    state: dict[str, torch.Tensor] = {}
    for m, attribute in attributes.items():
        state.update(program.modules[m].tensors(attribute))
    return text, state, list(shapes.fixed)


def _shape(shapes: NetShapes, value: int) -> str:
    shown = [
        str(size) if size is not None else shapes.name(value, axis) for axis, size in enumerate(shapes.sizes(value))
    ]
    return f"({', '.join(shown)}{',' if len(shown) == 1 else ''})"


# The parts of the file


def _header(net: str, origin: str, body: str) -> str:
    imports = [
        *(["import math"] if "math." in body else []),
        "from pathlib import Path",
        "",
        "import torch",
        *(["import torch.nn.functional as F"] if re.search(r"\bF\.", body) else []),
        "from safetensors.torch import load_file",
        "from torch import nn",
    ]
    sentence = " ".join(f"{net}, converted from {origin}".split())
    sentence = sentence if len(sentence) < WIDTH - 8 else sentence[: WIDTH - 12] + "..."
    return "\n".join([f'""{quoted(f"{sentence}.")}""', "", *imports])


def _loader(name: str) -> str:
    return f'''def load(weights=Path(__file__).with_suffix(".safetensors")):
    """Return the net with its trained weights, for inference."""
    net = {name}()
    net.load_state_dict(load_file(weights))
    return net.eval()'''


def _main(program: Program, example: str) -> str:
    lines = ['if __name__ == "__main__":']
    lines += lay_out(f"outputs = load()({example})", 4)
    if len(program.outputs) > 1:
        lines += ["    for name, output in outputs.items():", "        print(name, tuple(output.shape))"]
    else:
        lines += lay_out(f"print({quoted(next(iter(program.outputs), ''))}, tuple(outputs.shape))", 4)
    return "\n".join(lines)


# Classes


def _net_class(
    program: Program,
    name: str,
    attributes: Mapping[int, str],
    description: str,
    expected: Mapping[str, tuple[int | str, ...]],
) -> str:
    taken = set(program.functions)
    inputs = {v: unique(legal(program.names[v], "blob_"), taken) for v in program.inputs}
    made = [_constructed(program.modules[m], attribute) for m, attribute in attributes.items()]
    body = _forward(program, inputs, attributes)
    if expected:
        shapes = ", ".join(f"{quoted(program.names[v])}: {argument}.shape" for v, argument in inputs.items())
        wanted = ", ".join(f"{quoted(blob)}: {number(sizes)}" for blob, sizes in expected.items())
        body = [f"{check_shapes.__name__}({{{shapes}}}, {{{wanted}}})", *body]
    lines = [f"class {name}(nn.Module):", *_docstring(f"{description}.", 4), ""]
    return "\n".join([*lines, *_methods(made, ", ".join(inputs.values()), body)])


def _methods(made: Sequence[str], inputs: str, body: Sequence[str]) -> list[str]:
    lines = ["    def __init__(self):", "        super().__init__()"] if made else []
    for statement in made:
        lines += lay_out(statement, 8)
    lines += [*([""] if made else []), *lay_out(f"def forward(self, {inputs}):", 4)]
    for statement in body:
        lines += lay_out(statement, 8)
    return lines


def _docstring(text: str, indent: int) -> list[str]:
    space, text = " " * indent, quoted(text)[1:-1]
    if indent + len(text) + 6 <= WIDTH:
        return [f'{space}"""{text}"""']
    wrapped = textwrap.wrap(text, WIDTH - indent, break_long_words=False)  # which could part an escape
    lines = [space + line for line in wrapped]
    return [f'{space}"""Inputs and outputs.', "", *lines, f'{space}"""']


def _constructed(module: Module, attribute: str) -> str:
    call = module.constructor()
    if module.kind == "buffer":
        return f'self.register_buffer("{attribute}", {call})'
    return f"self.{attribute} = {call}"


# forward()


def _forward(program: Program, inputs: Mapping[int, str], attributes: Mapping[int, str]) -> list[str]:
    """Return the statements of the forward method, as text."""
    names, outputs = dict(inputs), program.outputs

    def text(kind: str, n: int) -> str:
        return names[n] if kind == "v" else f"self.{attributes[n]}"

    statements = _nested(program, program.statements, set(outputs.values()))
    last_read = {v: i for i, statement in enumerate(statements) for v in statement.values()}
    last_read.update(dict.fromkeys(outputs.values(), len(statements)))
    holder = {name: v for v, name in inputs.items()}

    def free(name: str, i: int) -> bool:
        return name not in holder or last_read.get(holder[name], -1) <= i

    lines = []
    for i, statement in enumerate(statements):
        expression = substitute(statement.expression, text)
        only_output = len(outputs) == 1 and statement.targets == tuple(outputs.values())
        if only_output and i == len(statements) - 1:
            return [*lines, f"return {expression}"]
        for v in statement.targets:
            wanted = legal(program.names[v], "blob_")
            wanted = f"{wanted}_" if wanted in program.functions else wanted
            passed = last_read.get(v, -1) == i + 1 and sum(v in s.values() for s in statements) == 1
            candidates = [*("x", "y")[: 2 * passed], wanted, *(f"{wanted}_{k}" for k in range(2, 1000))]
            unused = last_read.get(v, -1) < 0
            names[v] = "_" if unused else next(name for name in candidates if free(name, i))
            holder[names[v]] = v
        lines.append(f"{', '.join(names[v] for v in statement.targets)} = {expression}")
    if len(outputs) == 1:
        return [*lines, f"return {names[next(iter(outputs.values()))]}"]
    pairs = ", ".join(f"{quoted(name)}: {names[v]}" for name, v in outputs.items())
    return [*lines, f"return {{{pairs}}}"]


def _nested(program: Program, statements: Sequence[Statement], outputs: set[int]) -> list[Statement]:
    """Put a call into the next one, where that changes the value in place, or applies a function to each element."""
    reads = Counter(v for statement in statements for v in statement.values())
    found: list[Statement] = []
    for statement in statements:
        if found and (merged := _merged(program, found[-1], statement)) is not None:
            v = found[-1].targets[0]
            if reads[v] == 1 and v not in outputs:
                found[-1] = merged
                continue
        found.append(statement)
    return found


def _merged(program: Program, before: Statement, statement: Statement) -> Statement | None:
    """Return two statements as one that is easy to read, if there is one."""
    if len(before.targets) != 1 or statement.values().count(before.targets[0]) != 1:
        return None
    v = before.targets[0]
    in_place = len(statement.targets) == 1 and program.names[statement.targets[0]] == program.names[v]
    by_channel = all(t.dim() <= 1 for m in statement.modules() for t in program.modules[m].tensors("").values())
    of_module = before.modules() and statement.keeps_shape and by_channel
    if not (in_place or of_module):
        return None
    merged = substitute(statement.expression, lambda k, n: before.expression if (k, n) == ("v", v) else mark(k, n))
    length = len(substitute(merged, lambda k, n: f"self.{program.modules[n].layer}" if k == "m" else "x" * 5))
    if _depth(merged) > MOST_NESTED or length > WIDTH - 16:
        return None
    return Statement(statement.targets, merged, before.layer, statement.keeps_shape and before.keeps_shape)


def _depth(expression: str) -> int:
    depth = deepest = 0
    for character in expression:
        depth += (character in "([") - (character in ")]")
        deepest = max(deepest, depth)
    return deepest
