"""LZF, the compression inside PCD files: decoding only.

The one package on offer is a C extension without wheels, which would make every installation need a
compiler. Format: M. Lehmann's LibLZF. A control byte c < 32 copies c + 1 bytes; otherwise c >> 5
(7: plus the next byte) + 2 bytes repeat from ((c & 31) << 8 | next byte) + 1 bytes back.
"""

from __future__ import annotations


def decompress(data: bytes, size: int) -> bytes:
    """Return the ``size`` bytes that LZF data stand for.

    Raises:
        ValueError: The data are damaged.
    """
    out = bytearray()
    at, end = 0, len(data)
    try:
        while at < end:
            control = data[at]
            at += 1
            if control < 32:
                if at + control + 1 > end:
                    raise ValueError("the data end in the middle of a copy")
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            length += 2
            back = ((control & 31) << 8 | data[at]) + 1
            at += 1
            start = len(out) - back
            if start < 0:
                raise ValueError("a reference reaches before the beginning")
            if back >= length:
                out += out[start : start + length]
            else:  # the copy overlaps itself: the last `back` bytes repeat
                pattern = bytes(out[start:])
                out += (pattern * (length // back + 1))[:length]
            if len(out) > size:
                raise ValueError("more data than announced")
    except IndexError:
        raise ValueError("the data end in the middle of a reference") from None
    if len(out) != size:
        raise ValueError(f"{len(out)} bytes instead of {size}")
    return bytes(out)
