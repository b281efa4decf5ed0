"""A language server on standard input and output, by pygls (the extra ``netspec-caffe[lsp]``)."""

from __future__ import annotations

from typing import Any
from urllib.parse import urlparse

from lsprotocol import types as lsp
from pygls.exceptions import JsonRpcException, JsonRpcInvalidParams
from pygls.lsp.server import LanguageServer
from pygls.protocol import LanguageServerProtocol
from pygls.protocol.json_rpc import JsonRPCNotification
from pygls.uris import to_fs_path

from netspec import log
from netspec.errors import Where
from netspec.inspect.editor.answers import ERROR, HINT, WARNING, Diagnostic, Shapes, file_faults, text_faults
from netspec.inspect.editor.answers import completion as choices_at
from netspec.inspect.editor.answers import definition as definition_of
from netspec.inspect.editor.answers import hover as hover_text
from netspec.proto.format import format_text

NAME = "netspec"
MOST_CHARACTERS = 1 << 20  # of a document: nobody edits a larger prototxt by hand
TOO_LARGE = "the document has more than a megabyte: it is not looked at"
SEVERITIES = {
    ERROR: lsp.DiagnosticSeverity.Error,
    WARNING: lsp.DiagnosticSeverity.Warning,
    HINT: lsp.DiagnosticSeverity.Information,
}
KINDS = {
    "field": lsp.CompletionItemKind.Field,
    "type": lsp.CompletionItemKind.Class,
    "value": lsp.CompletionItemKind.EnumMember,
    "blob": lsp.CompletionItemKind.Variable,
}


class _Protocol(LanguageServerProtocol):
    """Answers a request whose parameters are of other types than the protocol's, which pygls only logs."""

    def structure_message(self, data: dict[str, Any]) -> Any:
        try:
            return super().structure_message(data)
        except JsonRpcException as fault:
            if "method" in data and isinstance(data.get("id"), int | str):
                self._send_response(data["id"], error=fault.to_response_error())
            return JsonRPCNotification(method="$/refused", jsonrpc=self.VERSION, params=None)


def make_server(version: str) -> LanguageServer:
    """Return the server: diagnostics, hover, definition, completion, formatting."""
    kind = lsp.TextDocumentSyncKind.Full
    server = LanguageServer(NAME, version, text_document_sync_kind=kind, protocol_cls=_Protocol)
    shapes: dict[str, Shapes] = {}

    def document(params: Any) -> Any:
        """Return the document of a request. Raises JsonRpcInvalidParams."""
        file = server.workspace.get_text_document(params.text_document.uri)
        try:
            large = len(file.source) > MOST_CHARACTERS
        except (OSError, ValueError) as fault:  # one that was not opened
            raise JsonRpcInvalidParams(f"{params.text_document.uri}: cannot be read: {fault}") from None
        if large:
            raise JsonRpcInvalidParams(TOO_LARGE)
        return file

    def faults_of(params: Any) -> list[Diagnostic]:
        uri = params.text_document.uri
        name = to_fs_path(uri) or uri
        try:
            return text_faults(document(params).source, name)
        except JsonRpcInvalidParams as fault:
            return [Diagnostic(Where(name, 1, 1), str(fault), ERROR)]

    def publish(uri: str, found: list[Diagnostic]) -> None:
        own = to_fs_path(uri) or uri
        told = [_diagnostic(each) for each in found if each.where.file == own]
        server.text_document_publish_diagnostics(lsp.PublishDiagnosticsParams(uri, told))

    def look(params: Any) -> None:
        """Check a saved file with all that lint finds; its text alone where it is not on disk."""
        uri, path = params.text_document.uri, to_fs_path(params.text_document.uri)
        faults = faults_of(params)
        if path and urlparse(uri).scheme == "file" and TOO_LARGE not in (each.message for each in faults):
            with log.silent():
                found, shapes[uri] = file_faults(path)
            faults = list({(each.where, each.message): each for each in (*faults, *found)}.values())
        publish(uri, faults)

    @server.feature(lsp.TEXT_DOCUMENT_DID_OPEN)
    def _opened(params: lsp.DidOpenTextDocumentParams) -> None:
        look(params)

    @server.feature(lsp.TEXT_DOCUMENT_DID_SAVE)
    def _saved(params: lsp.DidSaveTextDocumentParams) -> None:
        look(params)

    @server.feature(lsp.TEXT_DOCUMENT_DID_CHANGE)
    def _changed(params: lsp.DidChangeTextDocumentParams) -> None:
        publish(params.text_document.uri, faults_of(params))

    @server.feature(lsp.TEXT_DOCUMENT_HOVER)
    def _hover(params: lsp.HoverParams) -> lsp.Hover | None:
        file = document(params)
        said = hover_text(file.source, file.offset_at_position(params.position), shapes.get(file.uri, {}))
        return lsp.Hover(lsp.MarkupContent(lsp.MarkupKind.Markdown, said)) if said else None

    @server.feature(lsp.TEXT_DOCUMENT_DEFINITION)
    def _definition(params: lsp.DefinitionParams) -> lsp.Location | None:
        file = document(params)
        where = definition_of(file.source, file.offset_at_position(params.position))
        return lsp.Location(file.uri, _range(where)) if where else None

    @server.feature(lsp.TEXT_DOCUMENT_COMPLETION, lsp.CompletionOptions(trigger_characters=['"', ":", " "]))
    def _completion(params: lsp.CompletionParams) -> list[lsp.CompletionItem]:
        file = document(params)
        found = choices_at(file.source, file.offset_at_position(params.position))
        return [lsp.CompletionItem(each.text, kind=KINDS[each.kind], detail=each.detail) for each in found]

    @server.feature(lsp.TEXT_DOCUMENT_FORMATTING)
    def _formatting(params: lsp.DocumentFormattingParams) -> list[lsp.TextEdit] | None:
        file = document(params)
        if text_faults(file.source, file.uri):
            return None
        whole = lsp.Range(lsp.Position(0, 0), lsp.Position(len(file.lines), 0))
        return [lsp.TextEdit(whole, format_text(file.source, file.uri))]

    return server


def _diagnostic(found: Diagnostic) -> lsp.Diagnostic:
    return lsp.Diagnostic(
        _range(found.where), found.message, SEVERITIES[found.severity], code=found.rule or None, source=NAME
    )


def _range(where: Where) -> lsp.Range:
    """Return a place as the protocol counts: from 0; to the end of the line."""
    line, column = max(0, where.line - 1), max(0, where.column - 1)
    return lsp.Range(lsp.Position(line, column), lsp.Position(line + 1, 0))
