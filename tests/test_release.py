"""What a release says of itself agrees: version, changelog, citation, the form for faults."""

import re

from paths import ROOT

VERSION = re.search(r'^version = "(.+?)"', (ROOT / "pyproject.toml").read_text(), re.M)


def test_changelog_and_citation_are_of_this_version() -> None:
    assert VERSION is not None
    changes = (ROOT / "CHANGELOG.md").read_text()
    citation = (ROOT / "CITATION.cff").read_text()
    newest = re.search(r"^## (\S+) \((\d{4}-\d\d-\d\d)\)$", changes, re.M)
    assert newest is not None
    assert newest[1] == VERSION[1]
    assert f"\nversion: {VERSION[1]}\n" in citation
    assert f'\ndate-released: "{newest[2]}"\n' in citation


def test_the_paper_is_cited() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.findall(r"family-names: (\w+)", citation) == ["Qiu", "Ai", "Tian", "Wang", "Cao"]


def test_the_form_for_faults_asks_for_what_is_needed() -> None:
    form = (ROOT / ".github" / "ISSUE_TEMPLATE" / "fault.yml").read_text()
    fields = re.findall(r"id: (\w+)\n(.*?)(?=\n  - type|\Z)", form, re.S)
    assert [name for name, _ in fields] == ["what", "prototxt", "command", "log", "report"]
    assert all("required: true" in text for _, text in fields)
    assert "netspec bug-report" in form
