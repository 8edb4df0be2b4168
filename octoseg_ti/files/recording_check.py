"""The door of a recording: is it a whole MCAP file, bit for bit as it was written?"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import StreamReader, breakup_chunk

from octoseg_ti.errors import DataError
from octoseg_ti.files.validation import existing_file, parsing

MAGIC = b"\x89MCAP0\r\n"
_FOOTER = struct.Struct("<BQQQI")  # opcode, length, summary start, summary offset start, crc
_DATA_END = struct.Struct("<BQI")  # opcode, length, crc of everything before
_BLOCK = 1 << 20

BROKEN = "the file is damaged: fetch or record it again"
CUT = "fetch it again, or rescue its whole chunks with `rerun mcap convert --recover`"


def verify(path: str | Path) -> Path:
    """Check magic, summary checksum and data checksum of an MCAP file.

    A file of ours has all of them, so that a flip of any single bit is found here. Where a foreign
    writer left a checksum out (0), the chunks still carry their own.

    Args:
        path: The recording.

    Returns:
        The path.

    Raises:
        DataError: Missing, empty, not an MCAP, cut off, or changed since it was written.
    """
    path = existing_file(path)
    with parsing(path, "MCAP", BROKEN), open(path, "rb") as stream:
        head = stream.read(len(MAGIC))
        size = stream.seek(0, 2)
        if head != MAGIC:
            if MAGIC.startswith(head):
                raise DataError("cut off in its first bytes", path=path, hint=CUT)
            raise DataError("not an MCAP file", path=path, hint="name a recording (.mcap)")
        tail_size = _FOOTER.size + len(MAGIC)
        stream.seek(max(size - tail_size, 0))
        tail = stream.read()
        if size < tail_size + len(MAGIC) or not tail.endswith(MAGIC):
            count = _readable_stripes(path)
            what = f"cut off: its end is missing, {count} stripes can still be read"
            raise DataError(what, path=path, hint=CUT)
        opcode, length, summary, _, summary_crc = _FOOTER.unpack(tail[: _FOOTER.size])
        if opcode != Opcode.FOOTER or length != _FOOTER.size - 9:
            raise DataError("the footer is damaged", path=path, hint=BROKEN)
        end = size - tail_size
        data_end = summary if summary else end
        if not len(MAGIC) + _DATA_END.size <= data_end <= end:
            raise DataError("the footer is damaged", path=path, hint=BROKEN)
        if summary_crc:
            stream.seek(data_end)
            content = stream.read(size - len(MAGIC) - 4 - data_end)
            if zlib.crc32(content) != summary_crc:
                raise DataError("the summary fails its checksum", path=path, hint=BROKEN)
        stream.seek(data_end - _DATA_END.size)
        opcode, length, data_crc = _DATA_END.unpack(stream.read(_DATA_END.size))
        if opcode != Opcode.DATA_END or length != 4:
            raise DataError("the data section does not end properly", path=path, hint=BROKEN)
        if data_crc and _crc_of(stream, data_end - _DATA_END.size) != data_crc:
            raise DataError("the data fails its checksum", path=path, hint=BROKEN)
    return path


def records(path: Path, *, messages: bool = True) -> Iterator[Any]:
    """Give the records of a verified file in file order, those in chunks included.

    Args:
        path: A file that `verify` has passed.
        messages: False leaves the chunks packed.

    Raises:
        DataError: A record or a chunk does not hold what it must.
    """
    with parsing(path, "MCAP", BROKEN), open(path, "rb") as stream:
        limit = path.stat().st_size
        for record in StreamReader(stream, emit_chunks=True, record_size_limit=limit).records:
            if not isinstance(record, Chunk):
                yield record
            elif messages:
                yield from breakup_chunk(record, validate_crc=True)


def _crc_of(stream: IO[bytes], size: int) -> int:
    """Return the CRC-32 of the first bytes of a stream."""
    stream.seek(0)
    crc = 0
    while size > 0:
        block = stream.read(min(_BLOCK, size))
        if not block:
            break
        crc = zlib.crc32(block, crc)
        size -= len(block)
    return crc


def _readable_stripes(path: Path) -> int:
    """Return how many scan stripes lie before the damage, for the message."""
    count = 0
    topics: dict[int, str] = {}
    with open(path, "rb") as stream:
        try:
            reader = StreamReader(stream, emit_chunks=True, record_size_limit=path.stat().st_size)
            for record in reader.records:
                if not isinstance(record, Chunk):
                    continue
                for inner in breakup_chunk(record, validate_crc=True):
                    if isinstance(inner, Message):
                        count += topics.get(inner.channel_id) == "/scan/lines"
                    elif isinstance(inner, Channel):
                        topics[inner.id] = inner.topic
        except (McapError, ValueError, struct.error, zlib.error, MemoryError, RuntimeError):
            pass  # this is the damage
        except Exception as error:  # the error classes of the optional codecs
            if type(error).__module__.split(".")[0] not in ("zstandard", "zstd", "lz4", "_lz4"):
                raise
    return count
