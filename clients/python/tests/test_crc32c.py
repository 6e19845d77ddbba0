from __future__ import annotations

import numpy as np
import pytest

from scpsfm._crc32c import _numpy_crc32c, crc32c


def bit_by_bit(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x82F63B78 if crc & 1 else 0)
    return crc ^ 0xFFFFFFFF


# RFC 3720, B.4, and the check value of the catalogue of parametrised CRC algorithms.
KNOWN = [
    (b"", 0),
    (b"123456789", 0xE3069283),
    (bytes(32), 0x8A9136AA),
    (b"\xff" * 32, 0x62A8AB43),
    (bytes(range(32)), 0x46DD794E),
    (bytes(range(31, -1, -1)), 0x113FDB5C),
]


@pytest.mark.parametrize(("data", "expected"), KNOWN)
def test_known_values(data: bytes, expected: int) -> None:
    assert _numpy_crc32c(data) == crc32c(data) == expected


def test_any_length_is_that_of_the_definition() -> None:
    seed = 7
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    for length in (1, 2, 3, 4, 5, 1023, 1024, 1025, 2047, 2048, 4099, 10_000):
        data = rng.bytes(length)
        assert _numpy_crc32c(data) == bit_by_bit(data), length
    data = bytearray(rng.bytes(524_288))
    whole = _numpy_crc32c(bytes(data))
    data[300_001] ^= 16
    assert _numpy_crc32c(bytes(data)) != whole
