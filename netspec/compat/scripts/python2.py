"""Names the construct of Python 2 on which a program failed in Python 3."""

from __future__ import annotations

import re
import traceback

from netspec.errors import SpecError, Where

ADVICE = "convert it with `fissix -w`, then check each / between whole numbers, which rounds down in Python 2"
_STATEMENTS = {  # in a line that is not Python 3
    "the statement print": r"\bprint\s+[^\s(=]",
    "the statement exec": r"\bexec\s+[^\s(=]",
    "raise with a comma": r"\braise\s+[\w.]+\s*,",
    "except with a comma": r"\bexcept\b.*,\s*\w+\s*:",
    "the operator <>": r"<>",
    "an expression in backquotes": r"`",
    "an octal number without 0o": r"\b0[0-7]+\b",
    "a number with an L": r"\d[lL]\b",
    "a string with the prefix ur": r"\b[uU][rR]['\"]",
    "a parameter that is a tuple": r"(\bdef\b.*|\blambda\b\s*)\(.*\(|\blambda\b\s*\(",
}
_BUILTINS = {"basestring", "cmp", "execfile", "long", "raw_input", "reduce", "reload", "unichr", "unicode", "xrange"}
_MODULES = {"__builtin__", "ConfigParser", "cPickle", "cStringIO", "HTMLParser", "httplib", "Queue", "SocketServer"}
_MODULES |= {"StringIO", "Tkinter", "cookielib", "copy_reg", "urllib2", "urlparse"}
_ATTRIBUTES = {"getcwdu", "has_key", "ifilter", "imap", "iteritems", "iterkeys", "itervalues", "izip", "maxint"}


def fault_of_python2(fault: BaseException) -> SpecError | None:
    """Return an error that names the construct and its line, or None if a program failed for another reason."""
    if isinstance(fault, SyntaxError):
        where = Where(str(fault.filename), fault.lineno or 0, fault.offset or 0)
        found = [name for name, pattern in _STATEMENTS.items() if re.search(pattern, fault.text or "")]
        construct = "a block indented by tabs and blanks" if isinstance(fault, TabError) else found[0] if found else ""
    else:
        frames = traceback.extract_tb(fault.__traceback__)
        where = Where(frames[-1].filename, frames[-1].lineno or 0, 1) if frames else Where("")
        construct = _gone(fault)
    return SpecError(f"{construct} is Python 2, not 3; {ADVICE}", where) if construct else None


def _gone(fault: BaseException) -> str:
    """Return the name that Python 3 no longer has, "" if the fault is of another kind."""
    if isinstance(fault, TypeError) and ">>: 'builtin_function_or_method'" in str(fault):
        return "print >>"
    name = getattr(fault, "name", None)  # of a NameError, AttributeError or ModuleNotFoundError
    if imported := re.match(r"cannot import name '(\w+)'", str(fault)):
        name = imported[1]
    return name if name in _BUILTINS | _MODULES | _ATTRIBUTES else ""
