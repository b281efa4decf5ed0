"""The decorator that makes one test of many cases."""

import pytest

from each import each


def test_all_cases_run_and_the_failures_are_listed(tmp_path: object) -> None:
    seen = []

    @each("number, word", [(1, "a"), (2, "b"), (3, "c")])
    def body(tmp_path: object, number: int, word: str) -> None:
        seen.append((number, word))
        assert number != 2, f"wrong {word}"

    with pytest.raises(AssertionError, match=r"(?s)1 of 3 cases fail:\n\(2, 'b'\): AssertionError: wrong b"):
        body(tmp_path=tmp_path)
    assert seen == [(1, "a"), (2, "b"), (3, "c")]


def test_a_case_that_skips_itself_is_passed_over() -> None:
    seen = []

    @each("number", [1, 2])
    def body(number: int) -> None:
        seen.append(number)
        if number == 1:
            pytest.skip("not here")

    body()
    assert seen == [1, 2]
    with pytest.raises(pytest.skip.Exception):
        each("number", [1])(body.__wrapped__)()  # pyright: ignore[reportFunctionMemberAccess]
