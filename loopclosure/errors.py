"""The error that this package raises for a fault of the user, printed as compilers print theirs."""

from netspec.errors import InputError as InputError
