"""Caffe's Python interface: ``import netspec.pycaffe as caffe``. The code is in netspec/compat/pycaffe."""

from typing import TYPE_CHECKING, Any

from netspec.compat.alias import alias

if TYPE_CHECKING:
    from netspec.compat.pycaffe import *  # noqa: F403

    def __getattr__(name: str) -> Any: ...


alias(__name__, "netspec.compat.pycaffe")
