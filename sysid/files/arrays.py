"""Named arrays: MATLAB files (scipy; version 7.3 by h5py), HDF5 and NPZ."""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zipfile import ZipFile, is_zipfile

import numpy as np

from sysid.errors import InputError, refuse, shown
from sysid.files.recording import Column, Recording, is_abscissa
from sysid.files.tree import Allowance, check_all_links, check_data

_RATES = ("fs", "sample_rate", "samplerate", "sampling_rate", "srate")
_STEPS = ("dt", "delta_t", "increment")  # s


def read_npz(path: Path) -> list[Recording]:
    """Arrays of an NPZ file; nothing pickled is loaded."""
    try:
        _check_npz(path)
        with np.load(path, allow_pickle=False) as file:
            named = {name: (file[name], "") for name in file.files}
    except Exception as error:  # zipfile and NumPy raise many
        words = str(error) if isinstance(error, InputError) else str(error).partition(".")[0]
        raise InputError(
            f"{path} is no NPZ, or is damaged ({words}): write it with numpy.savez, of numbers alone"
        ) from None
    return _recordings(path, named)


def _check_npz(path: Path) -> None:
    """Refuse an archive whose arrays claim more numbers than it holds, or that unpacks to more than memory bears."""
    if not is_zipfile(path):  # NumPy takes it for pickles, and advises to load them
        raise InputError("it is no zip archive")
    allowance = Allowance(path.stat().st_size)
    with ZipFile(path) as archive:
        for member in archive.infolist():
            allowance.take(shown(member.filename), member.file_size)
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
                shape, _, dtype = read[version](file)
            if math.prod(shape) * dtype.itemsize > member.file_size:
                raise InputError(f"{shown(member.filename)} claims {math.prod(shape)} entries, and holds fewer")


def read_mat(path: Path) -> list[Recording]:
    """Arrays of a MATLAB file of any version."""
    from scipy.io import loadmat

    with path.open("rb") as file:
        begin = file.read(520)
    if b"\x89HDF\r\n\x1a\n" in (begin[:8], begin[512:]):  # behind 512 bytes of text in version 7.3
        return read_hdf5(path)
    try:
        check_matlab(path)
        found = loadmat(path, simplify_cells=True)
    except Exception as error:  # scipy raises many
        words = str(error) or type(error).__name__
        raise InputError(f"{path} is no MATLAB file, or is damaged ({words}): save it again") from None
    return _recordings(path, dict(_flat({name: one for name, one in found.items() if not name.startswith("__")})))


def read_hdf5(path: Path) -> list[Recording]:
    """Datasets of an HDF5 file, by their paths in it; an attribute ``unit`` or ``units`` is their unit."""
    import h5py

    named: dict[str, tuple[Any, str]] = {}
    allowance = Allowance(path.stat().st_size)

    def visit(name: str, item: Any) -> None:
        # MATLAB keeps the sizes of empty arrays, and texts as numbers.
        text = _word(item, "MATLAB_class") in ("char", "cell") or "MATLAB_empty" in item.attrs
        if not isinstance(item, h5py.Dataset) or name.startswith("#") or text:
            return
        if item.dtype.kind in "buifcV" and not item.dtype.hasobject:  # numbers, each of the same few bytes
            check_data(item, allowance)
            unit = _word(item, "unit") or _word(item, "units")
            named[name.replace("/", ".")] = (_values(item[()]), unit)

    try:
        with h5py.File(path, "r") as file:
            check_all_links(file)
            file.visititems(visit)
            matlab = any("MATLAB_class" in item.attrs for item in file.values())
    except Exception as error:  # h5py raises many
        raise InputError(f"{path} is no HDF5, or is damaged ({error}): write it again") from None
    # MATLAB stores its arrays column by column.
    return _recordings(path, {name: (one.T if matlab else one, unit) for name, (one, unit) in named.items()})


def _word(item: Any, name: str) -> str:
    """An attribute that is one text or number; "" where there is none, or a list, which may claim any memory."""
    if name not in item.attrs or item.attrs.get_id(name).shape not in ((), (1,)):
        return ""
    value = np.asarray(item.attrs[name]).item()
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _values(array: Any) -> Any:
    """Complex numbers as MATLAB 7.3 stores them, of fields real and imag, as complex numbers."""
    names = getattr(getattr(array, "dtype", None), "names", None)
    return array["real"] + 1j * array["imag"] if names and {"real", "imag"} <= set(names) else np.asarray(array)


def _flat(tree: dict[str, Any], above: str = "") -> Iterator[tuple[str, tuple[Any, str]]]:
    """Numbers in a structure of structures, by their dotted names."""
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{above}{name}.")
        elif np.asarray(value).dtype.kind in "buifc":
            yield above + name, (np.asarray(value), "")


def _recordings(path: Path, named: dict[str, tuple[Any, str]]) -> list[Recording]:
    """Columns of arrays: a vector is one, a matrix one a row or column along the longer side, ``name[1]`` and so on.

    Raises
    ------
    InputError
        Where there are no vectors; a square matrix, which does not tell whether its channels are rows or columns.
    """
    numbers = {name: (np.squeeze(one), unit) for name, (one, unit) in named.items() if one.dtype.kind in "buifc"}
    real = [(name, one) for name, (one, _) in numbers.items() if one.ndim == 0 and one.dtype.kind != "c"]
    scalars = [(name.rpartition(".")[2].lower(), float(one)) for name, one in real]
    lengths = {one.size for name, (one, _) in numbers.items() if one.ndim == 1 and is_abscissa(name)}
    vectors: dict[str, tuple[Any, str]] = {}
    remarks = []
    for name, (one, unit) in numbers.items():
        if one.size > 1:
            lines = _lines(one, lengths)
            vectors |= {f"{name}[{at}]" if one.ndim > 1 else name: (line, unit) for at, line in enumerate(lines, 1)}
            if one.ndim > 1 and lines.shape[1] not in lengths:
                remarks.append(f"array {name!r} is taken as {len(lines)} records of {lines.shape[1]} samples")
    if not vectors:
        raise InputError(f"{path} holds no arrays of records: a vector of samples a channel is needed, or a matrix")
    length = max(lengths or [one.size for one, _ in vectors.values()])
    square = next((name for name, (one, _) in numbers.items() if one.shape.count(length) > 1), None)
    words = f"has {length} rows and as many columns: which of them are its channels? Save a vector for each channel"
    refuse((square is not None, f"{path}: array {square!r} {words}"))
    other = [name for name, (one, _) in vectors.items() if one.size != length]
    remarks += [f"arrays of another length than {length} are left out: {', '.join(other[:8])}"] * bool(other)
    rates = [value for word, value in scalars if word in _RATES]
    if not any(np.iscomplexobj(one) for one, _ in vectors.values()):  # functions have steps of frequency
        rates += [1 / value for word, value in scalars if word in _STEPS and value > 0]
    columns = tuple(
        Column(name, one, unit, f"array {name!r}") for name, (one, unit) in vectors.items() if name not in other
    )
    return [Recording(path, columns, next(iter(rates), None), remarks=tuple(remarks))]


def _lines(array: Any, lengths: set[int]) -> Any:
    """Records of an array, a row each: along a side that is as long as time or frequency, else the longest."""
    sides = [side for side, size in enumerate(array.shape) if size in lengths] or range(array.ndim)
    side = max(sides, key=lambda at: array.shape[at])
    return np.moveaxis(array, side, -1).reshape(-1, array.shape[side])


_INT32, _MATRIX, _COMPRESSED = 5, 14, 15  # types of elements
_SPARSE, _OPAQUE = 5, 17  # classes of matrices: of a size that is not stored; without one
_COMPLEX = 0x800
_DEEPEST = 50  # cells in cells


def check_matlab(path: Path) -> None:
    """Refuse a file that claims more numbers than it holds, or unpacks to more than memory should bear.

    SciPy takes memory for the sizes that a file of version 4 or 5 claims. The format of version 5: MathWorks, "MAT-File
    Format", chapter 1 (elements of a tag and a value, matrices made of such elements, compressed ones by zlib). A file
    that is damaged otherwise may raise what it likes.
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
