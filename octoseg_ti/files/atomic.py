"""Outputs that are whole or absent: written beside the target, renamed when complete."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from octoseg_ti.errors import DataError

_HINT = "choose another output, or check the folder, its permissions and the free space"


class AtomicFile:
    """A file that appears under its name only when `commit` is called.

    Until then the bytes go to ``name.part`` in the same folder, so that the rename never crosses a
    file system. `abort` removes the part; an older file of that name stays as it was.
    """

    def __init__(self, path: str | Path, *, overwrite: bool = True) -> None:
        """Open the part for writing.

        Args:
            path: The file to write. A symbolic link is followed.
            overwrite: False refuses a file that exists.

        Raises:
            DataError: The folder is missing or not writable, or the name is taken by something
                that is not a file.
        """
        self.path = Path(path)
        self._target = Path(os.path.realpath(self.path))
        self.part = self._target.with_name(self._target.name + ".part")
        if self._target.exists():
            if not self._target.is_file():
                raise DataError("cannot write: this is not a regular file", path=path, hint=_HINT)
            if not overwrite:
                raise DataError("the file exists", path=path, hint="allow overwriting, or rename")
            if not os.access(self._target, os.W_OK):
                raise DataError("cannot write: the file is read-only", path=path, hint=_HINT)
        try:
            self.file: IO[bytes] = open(self.part, "wb")
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def write(self, data: bytes) -> int:
        """Append bytes, as a stream does.

        Raises:
            DataError: The disk is full or gone.
        """
        try:
            return self.file.write(data)
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def tell(self) -> int:
        """Return the position in the part, as a stream does."""
        return self.file.tell()

    def flush(self) -> None:
        """Hand the bytes to the system, as a stream does.

        Raises:
            DataError: The disk is full or gone.
        """
        try:
            self.file.flush()
        except OSError as error:
            raise cannot_write(self.path, error) from error

    def commit(self) -> None:
        """Close the part and give it its name.

        Raises:
            DataError: The last bytes could not be written, or the rename failed.
        """
        try:
            self.file.close()
            os.replace(self.part, self._target)
        except OSError as error:
            self.abort()
            raise cannot_write(self.path, error) from error

    def abort(self) -> None:
        """Remove the part; the target stays as it was."""
        try:
            self.file.close()
        except OSError:
            pass  # a full disk fails again on close; the part goes away all the same
        self.part.unlink(missing_ok=True)


def cannot_write(path: Path, error: OSError) -> DataError:
    """Return the one-line error for a failed write."""
    return DataError(f"cannot write: {error.strerror or error}", path=path, hint=_HINT)


@contextmanager
def replacing(path: str | Path, *, overwrite: bool = True) -> Iterator[AtomicFile]:
    """Give an open `AtomicFile`; commit on success, abort on any exception, Ctrl-C included.

    Raises:
        DataError: The output cannot be written.
    """
    output = AtomicFile(path, overwrite=overwrite)
    try:
        yield output
    except OSError as error:
        output.abort()
        raise cannot_write(output.path, error) from error
    except BaseException:
        output.abort()
        raise
    output.commit()
