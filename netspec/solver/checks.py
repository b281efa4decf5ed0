"""Checks of a solver's settings before anything is built. In Caffe some of these errors appear only after days."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from netspec.errors import Report, SpecError, raise_fault
from netspec.files.whole_file import whole_file, why_unwritable
from netspec.proto.schema import added_fields
from netspec.proto.source_map import Place
from netspec.solver.lr_policy import policy_faults
from netspec.solver.update import rule_faults

REGULARIZATIONS = ("L2", "L1")
_AT_LEAST_ONE = ("average_loss", "iter_size")
_NOT_NEGATIVE = ("max_iter", "display", "test_interval", "snapshot")


def check_settings(param: Any, node: Place, report: Report = raise_fault) -> None:
    """Report every error in the solver's own settings; its nets are checked separately."""
    for fault in (*rule_faults(param, node), *policy_faults(param, node)):
        report(fault)
    if param.regularization_type not in REGULARIZATIONS:
        message = f'unknown regularization_type "{param.regularization_type}", expected {" or ".join(REGULARIZATIONS)}'
        report(SpecError(message, node.find("regularization_type")))
    for name in _AT_LEAST_ONE + _NOT_NEGATIVE:
        value, least = getattr(param, name), int(name in _AT_LEAST_ONE)
        if value < least:
            report(SpecError(f"found {name} {value}, expected at least {least}", node.find(name)))
    for i, count in enumerate(param.test_iter):
        if count < 0:
            report(SpecError(f"found test_iter {count}, expected at least 0", node.find("test_iter", i)))
    if param.snapshot > 0 and not param.snapshot_prefix:
        report(SpecError("snapshot is given but snapshot_prefix is not", node.find("snapshot")))


def fields_without_effect(param: Any, node: Place, read: frozenset[str] = frozenset()) -> Iterator[str]:
    """Yield a line for each field of a fork that is given: the layers of the test nets read only ``read`` of them."""
    for name, field in added_fields.get(param.DESCRIPTOR.full_name, {}).items():
        if field.present(param) and name not in read:
            yield f"{node.find(name)}: {name} has no effect: it is a fork's, and nothing in these nets reads it"


def check_prefix(param: Any, node: Place, report: Report = raise_fault, *, try_it: bool = True) -> None:
    """Report a snapshot_prefix that is not writable.

    The permissions are checked; with ``try_it`` a file is also written (Caffe: CheckSnapshotWritePermissions).
    """
    probe = Path(f"{param.snapshot_prefix}_iter_0.tempfile")
    reason = why_unwritable(probe)
    if try_it and not reason:
        try:
            with whole_file(probe) as unfinished:
                unfinished.write_bytes(b"tried")
            probe.unlink()
        except SpecError as fault:
            reason = fault.message.removeprefix("cannot be written: ")
    if reason:
        begins = "" if probe.is_absolute() else f"; relative paths begin at {Path.cwd()}"
        advice = f"make sure that the directory exists and is writeable{begins}"
        message = f'cannot write to snapshot prefix "{param.snapshot_prefix}": {reason}; {advice}'
        report(SpecError(message, node.find("snapshot_prefix")))
