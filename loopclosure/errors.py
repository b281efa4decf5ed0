"""The error for faults in a user's files or settings, printed in the style of compilers (file:line:column)."""

from netspec.errors import InputError as InputError
