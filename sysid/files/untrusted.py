"""Checks of the files of others: what they hold and what they claim, before memory is taken for it.

HDF5 can take the numbers of a data set from any file of the machine (external storage, links to other files, virtual
data sets), unpack a few bytes to terabytes, and load a library for a filter that it does not know. All of it is
refused before a number is read.

SciPy takes memory for the sizes that a MATLAB file of version 4 or 5 claims. The format of version 5: MathWorks,
"MAT-File Format", chapter 1 (data elements of a tag and a value, matrices made of such elements, compressed ones by
zlib).
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sysid.errors import InputError, refuse, shown

_LEAST = 2**28  # bytes that any file may unpack to
_TIMES = 16  # its size, where that is more: records of dead channels pack well


class Allowance:
    """Bytes that are left for the numbers of a file.

    Parameters
    ----------
    size : int
        Of the file, bytes.

    Attributes
    ----------
    left : int
    """

    def __init__(self, size: int) -> None:
        self._size, self.left = size, max(_LEAST, _TIMES * size)

    def take(self, name: str, count: int) -> None:
        """Take away what an array needs.

        Raises
        ------
        InputError
            Where that is more than is left.
        """
        if count > self.left:
            raise InputError(
                f"{name} claims {count:.3g} bytes, in a file of {self._size} bytes: it is damaged, or export fewer "
                "channels a file"
            )
        self.left -= count


# Filters that are part of HDF5 or h5py, by their numbers: deflate, shuffle, Fletcher32, szip, n-bit, scale-offset, LZF.
_FILTERS = (1, 2, 3, 4, 5, 6, 32000)


def check_links(group: Any) -> None:
    """Refuse links of a group that are none to an object of the file itself.

    Raises
    ------
    InputError
        Names the link.
    """
    import h5py

    for name in group:
        if group.id.links.get_info(name.encode("utf-8", "surrogateescape")).type != h5py.h5l.TYPE_HARD:
            raise _link(f"{group.name.rstrip('/')}/{name}")


def check_all_links(file: Any) -> None:
    """The same of a whole file; a soft link to an object of the file stays, and is not followed."""
    import h5py

    def visit(name: str, link: Any) -> str | None:  # the first text ends the visit
        return name if isinstance(link, h5py.ExternalLink) else None

    found = file.visititems_links(visit)
    if found is not None:
        raise _link(found)


def _link(name: str) -> InputError:
    return InputError(f"{shown(name)} is a link to something else: only what stands in the file itself is read")


def check_data(item: Any, allowance: Allowance) -> None:
    """Refuse a data set whose numbers stand elsewhere, need a library, or would take more memory than is allowed.

    Raises
    ------
    InputError
        Names the data set.
    """
    import h5py

    properties, name = item.id.get_create_plist(), shown(item.name)
    if properties.get_layout() == h5py.h5d.VIRTUAL or properties.get_external_count():
        raise InputError(f"{name} has its numbers in another file: only what stands in the file itself is read")
    filters = {properties.get_filter(at)[0] for at in range(properties.get_nfilters())}
    if filters.difference(_FILTERS):
        raise InputError(f"{name} is packed by a filter that is no part of HDF5: write it without, or with gzip")
    allowance.take(name, _bytes_of(item.shape, item.dtype))


def attribute(group: Any, name: str, allowance: Allowance) -> Any:
    """The array of an attribute, or None where it is empty; refused where it would take more memory than is allowed."""
    stored = group.attrs.get_id(name)
    shape, dtype = stored.shape, stored.dtype  # each read from the file anew
    if shape is None:
        return None
    allowance.take(shown(name), _bytes_of(shape, dtype))
    refuse((dtype.kind == "O", f"{shown(name)}: an array of the type {dtype} stands in it"))
    found = np.zeros(shape, dtype)
    stored.read(found)
    return found


def _bytes_of(shape: tuple[int, ...] | None, dtype: Any) -> int:
    """Of an array in memory; None is the shape of nothing."""
    return 0 if shape is None else math.prod(shape) * int(dtype.itemsize)


_INT32, _MATRIX, _COMPRESSED = 5, 14, 15  # types of elements
_SPARSE, _OPAQUE = 5, 17  # classes of matrices: of a size that is not stored; without one
_COMPLEX = 0x800
_DEEPEST = 50  # cells in cells


def check_matlab(path: Path) -> None:
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
