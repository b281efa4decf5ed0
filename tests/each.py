"""Tests of many cases that are one test: it runs all of them, and fails with a list of those that failed."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import pytest

MOST = 20  # failures that are listed


def each(
    names: str, cases: Iterable[Any], ids: Callable[[Any], object] = str
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test for each case, as ``pytest.mark.parametrize`` does, but as one test; fixtures are shared by all.

    A case that skips itself is passed over; the test is skipped where all are, or where there is none.
    """
    wanted = [name.strip() for name in names.split(",")]
    cases = list(cases)

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def all_cases(**fixtures: Any) -> None:
            failed: list[tuple[str, BaseException]] = []
            skipped = 0
            for case in cases:
                values = dict(zip(wanted, case if len(wanted) > 1 else [case], strict=True))
                try:
                    test(**fixtures, **values)
                except pytest.skip.Exception:
                    skipped += 1
                except (Exception, pytest.fail.Exception) as fault:
                    failed.append((f"{ids(case)}: {type(fault).__name__}: {fault}", fault))
            if failed:
                listed = "\n".join(told for told, _ in failed[:MOST])
                raise AssertionError(f"{len(failed)} of {len(cases)} cases fail:\n{listed}") from failed[0][1]
            if skipped == len(cases):
                pytest.skip("no case here")

        parameters = inspect.signature(test).parameters
        rest = [parameter for name, parameter in parameters.items() if name not in wanted]
        setattr(all_cases, "__signature__", inspect.Signature(rest))  # noqa: B010  pytest reads it
        return all_cases

    return decorate


def last_parts(path: Any) -> str:
    """Return what names a file in a list of failures."""
    return "/".join(path.parts[-3:])
