"""Sizes that a MATLAB file of version 4 or 5 claims, checked before SciPy takes memory for them.

The format of version 5: MathWorks, "MAT-File Format", chapter 1 (data elements of a tag and a value, matrices made of
such elements, compressed ones by zlib).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

from sysid.errors import InputError
from sysid.files.allowance import Allowance

_INT32, _MATRIX, _COMPRESSED = 5, 14, 15  # types of elements
_SPARSE, _OPAQUE = 5, 17  # classes of matrices: of a size that is not stored; without one
_COMPLEX = 0x800
_DEEPEST = 50  # cells in cells


def check(path: Path) -> None:
    """Refuse a file that claims more numbers than it holds, or unpacks to more than memory should bear.

    Raises
    ------
    InputError
        Says so. A file that is damaged otherwise may raise what it likes.
    """
    from scipy.io import whosmat
    from scipy.io.matlab import matfile_version

    content = memoryview(path.read_bytes())
    if matfile_version(str(path))[0] == 0:
        for name, shape, kind in whosmat(path):
            _check_count(repr(name), math.prod(shape) * (kind != "sparse"), content.nbytes)
        return
    order = {b"IM": "<", b"MI": ">"}[bytes(content[126:128])]
    _check_elements(content[128:], order, Allowance(content.nbytes), 0)  # behind the header


def _check_elements(content: memoryview, order: str, allowance: Allowance, depth: int) -> None:
    for kind, value in _elements(content, order):
        if kind == _COMPRESSED:
            # So much and one byte more, which is refused.
            unpacked = zlib.decompressobj().decompress(value, allowance.left + 1)
            allowance.take("what is compressed in it", len(unpacked))
            _check_elements(memoryview(unpacked), order, allowance, depth + 1)
        elif kind == _MATRIX and value.nbytes:
            _check_matrix(value, order, allowance, depth)


def _check_matrix(content: memoryview, order: str, allowance: Allowance, depth: int) -> None:
    """Of a matrix: its flags, its sizes, its name, and then its numbers, or the matrices that it is made of."""
    if depth > _DEEPEST:
        raise InputError(f"cells or structures stand {_DEEPEST} deep in each other")
    parts = list(_elements(content, order))
    flags = struct.unpack(f"{order}I", parts[0][1][:4])[0]
    if flags & 0xFF != _OPAQUE:
        kind, sizes = parts[1]
        if kind != _INT32:
            raise InputError("a matrix states no sizes")
        count = math.prod(struct.unpack(f"{order}{sizes.nbytes // 4}i", sizes))
        if flags & 0xFF != _SPARSE:
            _check_count("a matrix", count, content.nbytes)
            allowance.take("a matrix", count * (16 if flags & _COMPLEX else 8))
    for part in parts:
        if part[0] == _MATRIX and part[1].nbytes:
            _check_matrix(part[1], order, allowance, depth + 1)


def _elements(content: memoryview, order: str) -> Iterator[tuple[int, memoryview]]:
    """Type and value of each element; those of at most four bytes have their size beside their type."""
    at = 0
    while at + 8 <= content.nbytes:
        kind, size = struct.unpack(f"{order}II", content[at : at + 8])
        begin = at + 8
        if kind >> 16:
            kind, size, begin = kind & 0xFFFF, kind >> 16, at + 4
        if begin + size > content.nbytes:
            raise InputError("it is cut short")
        yield kind, content[begin : begin + size]
        # All but compressed elements fill up to eight bytes.
        at = at + 8 if begin == at + 4 else begin + size + (-size % 8 if kind != _COMPRESSED else 0)


def _check_count(name: str, count: int, size: int) -> None:
    if not 0 <= count <= size:
        raise InputError(f"{name} claims {count} entries in {size} bytes")
