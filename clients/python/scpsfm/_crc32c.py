"""CRC-32C (Castagnoli, RFC 3720), which every chunk of an upload carries.

The package google-crc32c is used where it is installed. Otherwise numpy computes the sums of many equally long pieces
side by side and joins them in pairs, which takes some ten milliseconds for a chunk.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

__all__ = ["crc32c"]

_POLYNOMIAL = 0x82F63B78
"""x^32 + x^28 + x^27 + ... + 1, the lowest bit being the highest power."""

_LANES = 256
"""Pieces that are worked on side by side; a power of two."""

Words = NDArray[np.uint32]


def _byte_table() -> Words:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> np.uint32(1)) ^ np.uint32(_POLYNOMIAL), table >> np.uint32(1))
    return table.astype(np.uint32)


def _word_tables() -> Words:
    """Tables of four bytes at once: entry [k, b] is what byte b does to the sum when k bytes follow it. (4, 256)."""
    tables = np.empty((4, 256), dtype=np.uint32)
    tables[0] = _byte_table()
    for k in range(1, 4):
        tables[k] = (tables[k - 1] >> np.uint32(8)) ^ tables[0][tables[k - 1] & np.uint32(0xFF)]
    return tables


_TABLES = _word_tables()


def _apply(columns: Words, values: Words) -> Words:
    """A linear map of 32 bits, given by the images of the single bits, of every value."""
    result = np.zeros_like(values)
    for bit in range(32):
        result ^= np.where((values >> np.uint32(bit)) & np.uint32(1), columns[bit], np.uint32(0))
    return result


@lru_cache(maxsize=64)
def _zeros(length: int) -> Words:
    """The map of a sum to that after `length` zero bytes, by the images of single bits. (32,)."""
    bits = np.uint32(1) << np.arange(32, dtype=np.uint32)
    if length == 1:
        shifted: Words = (bits >> np.uint32(8)) ^ _TABLES[0][bits & np.uint32(0xFF)]
        return shifted
    half = _zeros(length // 2)
    twice = _apply(half, half)
    return _apply(_zeros(1), twice) if length % 2 else twice


def _serial(data: bytes, crc: int) -> int:
    table = _TABLES[0].tolist()
    for byte in data:
        crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
    return crc


def _numpy_crc32c(data: bytes) -> int:
    words = len(data) // (4 * _LANES)
    crc = 0xFFFFFFFF
    if words > 0:
        length = 4 * words
        lanes = np.frombuffer(data, dtype="<u4", count=words * _LANES).reshape(_LANES, words)
        # The first piece begins with the sum so far, the others with 0: the sum is linear.
        sums = np.zeros(_LANES, dtype=np.uint32)
        sums[0] = crc
        low = np.uint32(0xFF)
        for column in np.ascontiguousarray(lanes.T):
            sums = sums ^ column
            sums = (
                _TABLES[3][sums & low]
                ^ _TABLES[2][(sums >> np.uint32(8)) & low]
                ^ _TABLES[1][(sums >> np.uint32(16)) & low]
                ^ _TABLES[0][sums >> np.uint32(24)]
            )
        while len(sums) > 1:
            sums = _apply(_zeros(length), sums[0::2]) ^ sums[1::2]
            length *= 2
        crc = int(sums[0])
    return _serial(data[4 * words * _LANES :], crc) ^ 0xFFFFFFFF


def _chosen() -> Callable[[bytes], int]:
    try:
        import google_crc32c
    except ImportError:
        return _numpy_crc32c
    return lambda data: int(google_crc32c.value(data))


crc32c: Callable[[bytes], int] = _chosen()
"""CRC-32C of bytes, 0 to 2^32 - 1."""
