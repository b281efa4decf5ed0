"""OpenCV's ``cv2.dnn`` for Caffe's files: ``from netspec import dnn``. The code is in netspec/compat/dnn."""

from typing import TYPE_CHECKING, Any

from netspec.compat.alias import alias

if TYPE_CHECKING:
    from netspec.compat.dnn import *  # noqa: F403

    def __getattr__(name: str) -> Any: ...


alias(__name__, "netspec.compat.dnn")
