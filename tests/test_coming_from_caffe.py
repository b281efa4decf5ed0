"""Every difference from Caffe that the documentation names is shown by a test that is there."""

import re

import pytest

from paths import ROOT

PAGE = ROOT / "docs" / "coming-from-caffe.md"
ROWS = [line for line in PAGE.read_text().splitlines() if line.startswith("| ") and not line.startswith("| Caffe ")]
TESTS = {
    name
    for path in ROOT.glob("tests/**/test_*.py")
    for name in re.findall(r"^def (test_\w+)\(", path.read_text(), re.MULTILINE)
}


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.split("|")[1].strip()[:50])
def test_each_difference_is_shown_by_a_test(row: str) -> None:
    assert len(re.findall(r"(?<!\\)\|", row)) == 4, "expected three columns"
    named = re.findall(r"\btest_\w+", row[row.index("<!--") :])
    assert named
    assert set(named) <= TESTS


def test_the_readme_leads_to_the_page() -> None:
    assert "docs/coming-from-caffe.md" in (ROOT / "README.md").read_text()
