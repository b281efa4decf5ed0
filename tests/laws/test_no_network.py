"""No command reaches for the network."""

import socket
from pathlib import Path
from typing import NoReturn

import pytest

from faults.commands import CASES

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", CASES)
def test_a_command_opens_no_connection(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object, **options: object) -> NoReturn:
        pytest.fail("a connection")

    monkeypatch.chdir(tmp_path)
    Path("out").mkdir()
    CASES[name].prepare()
    for function in ("connect", "connect_ex", "bind", "sendto"):
        monkeypatch.setattr(socket.socket, function, refuse)
    for function in ("getaddrinfo", "gethostbyname", "create_connection"):
        monkeypatch.setattr(socket, function, refuse)
    assert CASES[name].main(CASES[name].words) == 0
