"""``netspec lsp`` as a program, spoken to as editors speak to it."""

import asyncio
import sys
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("pygls")

from lsprotocol import types as lsp
from pygls.lsp.client import LanguageClient

NET = """layer { name: "in" type: "Input" top: "x" input_param { shape { dim: 1 dim: 3 } } }
layer { name: "n" type: "BatchNorm" bottom: "x" top: "y" }
"""


@pytest.mark.slow
def test_an_editor_opens_a_net_asks_and_changes_it(tmp_path: Path) -> None:
    path = tmp_path / "net.prototxt"
    path.write_text(NET)
    asyncio.run(asyncio.wait_for(session(path), timeout=120))


async def session(path: Path) -> None:
    client: Any = LanguageClient("test", "1")
    published: asyncio.Queue[Any] = asyncio.Queue()
    client.feature(lsp.TEXT_DOCUMENT_PUBLISH_DIAGNOSTICS)(lambda params: published.put_nowait(params.diagnostics))
    await client.start_io(sys.executable, "-m", "netspec", "lsp")
    uri = path.as_uri()
    file = lsp.TextDocumentIdentifier(uri)
    able = lsp.ClientCapabilities()
    started = await client.initialize_async(lsp.InitializeParams(able, root_uri=path.parent.as_uri()))
    assert started.capabilities.hover_provider
    assert started.capabilities.document_formatting_provider
    client.initialized(lsp.InitializedParams())
    client.text_document_did_open(lsp.DidOpenTextDocumentParams(lsp.TextDocumentItem(uri, "prototxt", 1, NET)))
    (warning,) = await published.get()
    assert (warning.code, warning.range.start) == ("batchnorm-without-scale", lsp.Position(1, 0))
    hover = await client.text_document_hover_async(lsp.HoverParams(file, lsp.Position(1, 46)))
    assert hover.contents.value == "blob **x**: 1×3"
    found = await client.text_document_definition_async(lsp.DefinitionParams(file, lsp.Position(1, 46)))
    assert found.range.start == lsp.Position(0, 0)
    offered = await client.text_document_completion_async(lsp.CompletionParams(file, lsp.Position(1, 8)))
    assert "bottom" in [item.label for item in offered]
    whole = lsp.TextDocumentContentChangeWholeDocument(NET + "layer {")
    changed = lsp.VersionedTextDocumentIdentifier(2, uri)
    client.text_document_did_change(lsp.DidChangeTextDocumentParams(changed, [whole]))
    (fault,) = await published.get()
    assert fault.severity == lsp.DiagnosticSeverity.Error
    await client.shutdown_async(None)
    client.exit(None)
    await client.stop()
