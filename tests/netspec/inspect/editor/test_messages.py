"""What an editor may send, and what it gets: an answer to every request, whatever came before it."""

import io
import json
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pygls")

from netspec.inspect.editor.messages import MOST_BYTES, Messages
from netspec.inspect.editor.server import MOST_CHARACTERS, make_server

NET = 'layer { name: "in" type: "Input" top: "x" input_param { shape { dim: 1 dim: 3 } } }\n'


def framed(message: object) -> bytes:
    body = message if isinstance(message, bytes) else json.dumps(message).encode()
    return b"Content-Length: %d\r\n\r\n%s" % (len(body), body)


def request(number: int, method: str, params: object) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "id": number, "method": method, "params": params}


def notification(method: str, params: object) -> dict[str, Any]:
    return {"jsonrpc": "2.0", "method": method, "params": params}


def hover(number: int, uri: object, line: object = 0, character: object = 2) -> dict[str, Any]:
    position = {"line": line, "character": character}
    return request(number, "textDocument/hover", {"textDocument": {"uri": uri}, "position": position})


def opened(uri: str, text: str) -> dict[str, Any]:
    document = {"uri": uri, "languageId": "prototxt", "version": 1, "text": text}
    return notification("textDocument/didOpen", {"textDocument": document})


def talk(*said: object) -> list[dict[str, Any]]:
    """Return what the server sends when an editor begins, says this and ends; bytes are sent as they are."""
    begin = request(1, "initialize", {"capabilities": {}, "processId": None, "rootUri": None})
    end = [request(99, "shutdown", None), notification("exit", None)]
    sent = b"".join(each if isinstance(each, bytes) else framed(each) for each in (begin, *said, *end))
    answers = io.BytesIO()
    answers.close = lambda: None  # type: ignore[method-assign]
    make_server("1").start_io(Messages(io.BytesIO(sent)), answers)  # type: ignore[arg-type]
    return [json.loads(part.partition(b"\r\n\r\n")[2]) for part in answers.getvalue().split(b"Content-Length: ")[1:]]


def answer(found: list[dict[str, Any]], number: int) -> dict[str, Any]:
    (answer,) = [each for each in found if each.get("id") == number]
    return answer


@pytest.mark.parametrize(
    "params",
    [None, [], 5, "x", {}, {"textDocument": 5}, {"textDocument": {"uri": 5}, "position": {"line": "a"}}],
    ids=repr,
)
def test_a_request_with_wrong_parameters_is_answered(params: object) -> None:
    found = talk(request(7, "textDocument/hover", params))
    assert answer(found, 7)["error"]["code"] < 0
    assert "result" in answer(found, 99)


@pytest.mark.slow
@pytest.mark.parametrize(
    "noise",
    [
        b'Content-Length: -5\r\n\r\n{"a":1}',
        b'Content-Length: x\r\n\r\n{"a":1}',
        b"Content-Length: 99999999999999999999999\r\n\r\n{}",
        b'\r\n\r\n{"jsonrpc": "2.0"}',
        b"\x00\xff\r\n\n\n",
        framed(b"[]"),
        framed(b'"x"'),
        framed(b"{"),
        framed(b"\xff\xfe"),
        framed(b"[" * 100_000),
        framed(b'{"jsonrpc": "3", "id": 3, "method": "x"}'),
        framed(b'{"jsonrpc": "2.0", "id": {}, "method": "textDocument/hover"}'),
    ],
    ids=lambda noise: repr(noise[:40]),
)
def test_after_noise_requests_are_answered(noise: bytes) -> None:
    found = talk(noise, opened("file:///net.prototxt", NET), hover(5, "file:///net.prototxt"))
    assert "field of NetParameter" in answer(found, 5)["result"]["contents"]["value"]


def test_a_document_of_more_than_a_megabyte_is_refused() -> None:
    found = talk(opened("file:///big.prototxt", NET + "#" * MOST_CHARACTERS), hover(5, "file:///big.prototxt"))
    assert "more than a megabyte" in answer(found, 5)["error"]["message"]
    (published,) = [each for each in found if each.get("method") == "textDocument/publishDiagnostics"]
    assert ["more than a megabyte" in each["message"] for each in published["params"]["diagnostics"]] == [True]
    found = talk(framed(b" " * (MOST_BYTES + 1)), hover(5, "file:///none"))
    assert "error" in answer(found, 5)


@pytest.mark.parametrize("place", [(-1, 0), (0, -1), (10**9, 10**9), (0, 10**9)])
def test_places_outside_the_text(place: tuple[int, int], tmp_path: Path) -> None:
    uri = (tmp_path / "net.prototxt").as_uri()
    found = talk(opened(uri, NET), hover(5, uri, *place), hover(6, "file:///no/such/file"))
    assert {"result", "error"} & set(answer(found, 5))
    assert "error" in answer(found, 6)
