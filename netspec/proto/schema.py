"""Caffe's messages as Python classes, in a descriptor pool of their own.

The pool is private: another "caffe.proto" in the process (pycaffe's, a converter's) does not clash with this one, and no
generated module ties netspec to one version of protobuf. ``caffe.desc`` is ``caffe.proto`` compiled; how, says its head.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

PACKAGE = "caffe"
_LAST_NUMBER = 1 << 29  # field numbers end before this

#: The pool; :mod:`netspec.proto.dialect` adds the files of forks to it.
pool = descriptor_pool.DescriptorPool()


def _load() -> None:
    files = descriptor_pb2.FileDescriptorSet()
    files.ParseFromString(Path(__file__).with_name("caffe.desc").read_bytes())
    for file in files.file:
        for declared in file.message_type:
            # Numbers above Caffe's own are open for the fields of forks: as extensions they can come later, and do not
            # change the classes below.
            declared.extension_range.add(start=max(f.number for f in declared.field) + 1, end=_LAST_NUMBER)
        pool.Add(file)


_load()


def message(name: str) -> type[Message]:
    """Return the class of a message of the schema, e.g. ``message("PoolingParameter")``.

    Raises KeyError for a name that the schema does not have.
    """
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.{name}"))


if TYPE_CHECKING:

    class _CaffeMessage(Message):
        """What a type checker may know: the fields exist at run time only."""

        def __init__(self, **fields: Any) -> None: ...
        def __getattr__(self, name: str) -> Any: ...
        def __setattr__(self, name: str, value: Any) -> None: ...

    class BlobShape(_CaffeMessage): ...

    class BlobProto(_CaffeMessage): ...

    class BlobProtoVector(_CaffeMessage): ...

    class Datum(_CaffeMessage): ...

    class FillerParameter(_CaffeMessage): ...

    class NetParameter(_CaffeMessage): ...

    class SolverParameter(_CaffeMessage): ...

    class SolverState(_CaffeMessage): ...

    class NetState(_CaffeMessage): ...

    class NetStateRule(_CaffeMessage): ...

    class ParamSpec(_CaffeMessage): ...

    class LayerParameter(_CaffeMessage): ...

    class V1LayerParameter(_CaffeMessage): ...

    class V0LayerParameter(_CaffeMessage): ...

    class TransformationParameter(_CaffeMessage): ...

else:
    BlobShape = message("BlobShape")
    BlobProto = message("BlobProto")
    BlobProtoVector = message("BlobProtoVector")
    Datum = message("Datum")
    FillerParameter = message("FillerParameter")
    NetParameter = message("NetParameter")
    SolverParameter = message("SolverParameter")
    SolverState = message("SolverState")
    NetState = message("NetState")
    NetStateRule = message("NetStateRule")
    ParamSpec = message("ParamSpec")
    LayerParameter = message("LayerParameter")
    V1LayerParameter = message("V1LayerParameter")
    V0LayerParameter = message("V0LayerParameter")
    TransformationParameter = message("TransformationParameter")
