"""The one error that bad input raises: which file, what is wrong, what to do."""

from __future__ import annotations

from pathlib import Path


class DataError(ValueError):
    """The data cannot be used; the message is one line for the user."""

    def __init__(self, what: str, *, path: str | Path | None = None, hint: str = "") -> None:
        """Build the line "path: what; hint"."""
        self.path = None if path is None else str(path)
        self.what = what
        self.hint = hint
        where = "" if path is None else f"{path}: "
        super().__init__(f"{where}{what}" + (f"; {hint}" if hint else ""))


class MissingPackageError(ImportError):
    """An optional package is not installed; the message says how to install it."""

    def __init__(self, package: str, extra: str, purpose: str) -> None:
        """Build the line that names the package, what needs it and the install command."""
        super().__init__(f"{purpose} needs {package}: pip install 'octoseg[{extra}]'")
