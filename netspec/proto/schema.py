"""Caffe's messages as Python classes, in a separate descriptor pool.

The pool is private: another "caffe.proto" in the process (pycaffe's, a converter's) does not clash with this one, and
no generated module ties netspec to one version of protobuf. ``caffe.desc`` is the compiled ``caffe.proto``, which
contains the command to compile it. ``caffe_pb2.pyi`` is generated with it, for type checkers.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

from netspec.errors import SpecError

M = TypeVar("M", bound=Message)

PACKAGE = "caffe"
SCOPE = "FieldsOf"  # the fields that a fork adds to a message are declared inside one of this name and the message's
_LAST_NUMBER = 1 << 29  # field numbers are below this

#: The pool. The messages and fields of forks are added to it when they are first needed (netspec/dialects/registry.py).
pool = descriptor_pool.DescriptorPool()
_declarations: dict[str, descriptor_pb2.DescriptorProto] = {}  # by the message's full name


def add_file(file: descriptor_pb2.FileDescriptorProto) -> None:
    """Add the messages of a file to the schema. Raises TypeError if they conflict with it."""
    pool.Add(file)
    for declared in file.message_type:
        _declare(f"{file.package}.{declared.name}", declared)


def _declare(full_name: str, declared: descriptor_pb2.DescriptorProto) -> None:
    _declarations[full_name] = declared
    for nested in declared.nested_type:
        _declare(f"{full_name}.{nested.name}", nested)


def _load() -> None:
    files = descriptor_pb2.FileDescriptorSet()
    files.ParseFromString(Path(__file__).with_name("caffe.desc").read_bytes())
    for file in files.file:
        for declared in file.message_type:
            # Numbers above Caffe's own are reserved for the fields of forks. Extensions can be added later and do
            # not change the classes below.
            declared.extension_range.add(start=max(f.number for f in declared.field) + 1, end=_LAST_NUMBER)
        add_file(file)


_load()


def message(name: str) -> type[CaffeMessage]:
    """Return the class of a message of the schema, e.g. ``message("PoolingParameter")``.

    Raises KeyError for a name that the schema does not have.
    """
    found: Any = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.{name}"))
    return found


if TYPE_CHECKING:
    from netspec.proto import caffe_pb2  # a stub, which import-linter counts as part of the package

    BlobProto = caffe_pb2.BlobProto
    BlobProtoVector = caffe_pb2.BlobProtoVector
    BlobShape = caffe_pb2.BlobShape
    Datum = caffe_pb2.Datum
    FillerParameter = caffe_pb2.FillerParameter
    LayerParameter = caffe_pb2.LayerParameter
    NetParameter = caffe_pb2.NetParameter
    NetState = caffe_pb2.NetState
    NetStateRule = caffe_pb2.NetStateRule
    ParamSpec = caffe_pb2.ParamSpec
    SolverParameter = caffe_pb2.SolverParameter
    SolverState = caffe_pb2.SolverState
    TransformationParameter = caffe_pb2.TransformationParameter
    V0LayerParameter = caffe_pb2.V0LayerParameter
    V1LayerParameter = caffe_pb2.V1LayerParameter
    CaffeMessage = Any  # a message of any type, including its fields and enums
    PhaseValue = caffe_pb2.Phase.ValueType

else:
    CaffeMessage = Message
    PhaseValue = int
    _NAMES = """BlobProto BlobProtoVector BlobShape Datum FillerParameter LayerParameter NetParameter NetState
        NetStateRule ParamSpec SolverParameter SolverState TransformationParameter V0LayerParameter V1LayerParameter"""
    globals().update({name: message(name) for name in _NAMES.split()})

TRAIN, TEST = PhaseValue(0), PhaseValue(1)  # enum Phase
PHASES = {"TRAIN": TRAIN, "TEST": TEST}
PHASE_NAMES = ("TRAIN", "TEST")


def phase_of(phase: str | int) -> PhaseValue:
    """Return a phase by its name, in upper or lower case, or by its number. Raises SpecError for an unknown name."""
    if isinstance(phase, str) and phase.upper() in PHASES:
        return PHASES[phase.upper()]
    if phase in PHASES.values():
        return PhaseValue(int(phase))
    raise SpecError(f"found phase {phase!r}, expected TRAIN or TEST")


@dataclass(frozen=True)
class Field:
    """A field of Caffe or of a fork, for reading and writing text.

    ``type`` is a FieldDescriptorProto.Type. ``descriptor`` is protobuf's; its property for the label differs between
    versions of protobuf.
    """

    name: str
    type: int
    repeated: bool
    required: bool
    descriptor: Any

    def get(self, message: Message) -> Any:
        """Return the value, or its default if it is absent; for a repeated field, its list."""
        return message.Extensions[self.descriptor] if self.descriptor.is_extension else getattr(message, self.name)

    def set(self, message: Message, value: Any) -> None:
        """Set a singular scalar."""
        if self.descriptor.is_extension:
            message.Extensions[self.descriptor] = value
        else:
            setattr(message, self.name, value)

    def assign(self, message: Message, value: Any) -> None:
        """Set the field, whatever its type; of a repeated one, add one or several values."""
        if self.repeated:
            several = not isinstance(value, (str, bytes, int, float, Message))
            self.get(message).extend(value if several else [value])
        elif isinstance(value, Message):
            self.get(message).CopyFrom(value)
        else:
            self.set(message, value)

    def present(self, message: Message) -> bool:
        """Return whether a value was given."""
        if self.repeated:
            return len(self.get(message)) > 0
        if self.descriptor.is_extension:
            return message.HasExtension(self.descriptor)
        return message.HasField(self.name)


_own_fields: dict[str, dict[str, Field]] = {}
_of_forks: dict[str, Field] = {}  # the fields of forks, by the full name of their descriptor
_newest: dict[tuple[str, str], Field] = {}  # of those with the same name in a message; a user's file comes last


def as_field(declared: descriptor_pb2.FieldDescriptorProto, descriptor: Any) -> Field:
    """Return the Field for a declaration and its descriptor in the pool."""
    return Field(
        declared.name,
        descriptor.type,
        declared.label == descriptor_pb2.FieldDescriptorProto.LABEL_REPEATED,
        declared.label == descriptor_pb2.FieldDescriptorProto.LABEL_REQUIRED,
        descriptor,
    )


def add_field(declared: descriptor_pb2.FieldDescriptorProto, descriptor: Any) -> Field:
    """Make a field of a fork known, given by its declaration and its descriptor in the pool, and return it.

    New values of an enum of Caffe's are a field with the name of Caffe's field.
    """
    field = _of_forks.setdefault(descriptor.full_name, as_field(declared, descriptor))
    _newest[descriptor.containing_type.full_name, field.name] = field
    return field


def extension(name: str) -> Field:
    """Return a known field of a fork by the full name of its descriptor; see :func:`extension_name`."""
    return _of_forks[name]


def fields_of(descriptor: Any) -> dict[str, Field]:
    """Return the fields that a message has by itself, without those of forks, by name."""
    name = descriptor.full_name
    if name not in _own_fields:
        declared = _declarations[name].field
        _own_fields[name] = {f.name: as_field(f, descriptor.fields_by_name[f.name]) for f in declared}
    return _own_fields[name]


def given(message: Message) -> list[Field]:
    """Return the fields that were given, including those of forks, in the order of their numbers."""
    own, found = fields_of(message.DESCRIPTOR), []
    descriptors: Any = [descriptor for descriptor, _ in message.ListFields()]
    for descriptor in descriptors:
        found.append(_of_forks[descriptor.full_name] if descriptor.is_extension else own[descriptor.name])
    return found


def copy_without(message: M, leave_out: Collection[str]) -> M:
    """Return a copy of a message without some of its fields; these are never copied, not even temporarily."""
    result = type(message)()
    for field in given(message):
        if field.name not in leave_out:
            field.assign(result, field.get(message))
    return result


def same_field(field: Field, message: Message) -> Field | None:
    """Return the field of a message, perhaps of another type, with the name and the fork of ``field``; or None."""
    if not field.descriptor.is_extension:
        return fields_of(message.DESCRIPTOR).get(field.name)
    if field.descriptor.containing_type is message.DESCRIPTOR:
        return field
    return _of_forks.get(extension_name(field.descriptor.file.package, message.DESCRIPTOR.name, field.name))


def extension_name(package: str, message: str, field: str) -> str:
    """Return the full name of the descriptor with which the fork of a package extends a message, given by its name."""
    return f"{package}.{SCOPE}{message}.{field}"


def value(message: Message, name: str) -> Any:
    """Return the value of a field, or its default if it is absent; ``name`` may be a field of a fork."""
    own = fields_of(message.DESCRIPTOR).get(name)
    if own is not None:
        return own.get(message)
    for field in given(message):
        if field.name == name:
            return field.get(message)
    return _newest[message.DESCRIPTOR.full_name, name].get(message)


def given_fields(message: Message) -> set[str]:
    """Return the names of the fields that were given, including those of forks."""
    return {field.name for field, _ in message.ListFields()}


def has(message: Message, name: str) -> bool:
    """Return whether a field was given; ``name`` may be a field of a fork."""
    return name in given_fields(message)
