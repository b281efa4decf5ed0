"""What both wings need to start their programs is written twice, since neither imports the other; it stays the same."""

from paths import ROOT


def test_both_wings_start_their_programs_alike() -> None:
    netspec, loopclosure = ((ROOT / wing / "__main__.py").read_text() for wing in ("netspec", "loopclosure"))
    assert loopclosure == netspec.replace("netspec", "loopclosure")
