"""A tree of dictionaries, lists, arrays and texts as an HDF5 file with its own SHA-256; checks of HDF5 of others.

::

    byte 0      text: format of the content, length and SHA-256 of the file
    byte 512    HDF5: a group for each dictionary or list, attributes for numbers and short texts, datasets for the rest

What may stand in a tree: dict (its keys are names), list, numpy array of numbers, str, tuple of str, bool, int, float
and None. It comes back as it was, but for the order of a dictionary's keys and for NUL characters at the end of a
text. No class of the package is known here.

HDF5 can take the numbers of a data set from any file of the machine (external storage, links to other files, virtual
data sets), unpack a few bytes to terabytes, and load a library for a filter that it does not know. All of it is
refused before a number is read, and so is a file that claims far more memory than it has bytes (`Allowance`).
"""

from __future__ import annotations

import hashlib
import io
import math
import re
from typing import Any

import numpy as np

from sysid.errors import InputError, refuse, shown

Tree = dict[str, Any]

_BLOCK = 512  # HDF5 allows 512, 1024, 2048, ... bytes of somebody else's before its own
_MAGIC = b"sysid file, format "
_HEADER = re.compile(
    re.escape(_MAGIC) + rb"(\d+), (\d+) bytes: 512 of text, then HDF5\n"
    rb"SHA-256 of the file, with zeros in the place of these 64 digits:\n([0-9a-f]{64})\n\0*"
)
_LENGTH = "[]"  # the attribute by which a list is told from a dictionary
_LONGEST_ATTRIBUTE = 4096  # bytes of a text; HDF5 itself allows 64 kB
_NUMBERS = "buifc"  # kinds of arrays
_LEAST = 2**28  # bytes that any file may unpack to
_TIMES = 16  # its size, where that is more: records of dead channels pack well
# Filters that are part of HDF5 or h5py, by their numbers: deflate, shuffle, Fletcher32, szip, n-bit, scale-offset, LZF.
_FILTERS = (1, 2, 3, 4, 5, 6, 32000)


def to_bytes(tree: Tree, number: int) -> bytes:
    """The file of a tree, with the number of its format: the same bytes for one tree, whatever the order of its keys.

    Raises
    ------
    InputError
        Where something else stands in the tree than listed above; says where.
    """
    import h5py

    check_tree(tree)
    image = io.BytesIO()
    # Groups as HDF5 has them since 1.8 take a fraction of the room of those before.
    with h5py.File(image, "w", userblock_size=_BLOCK, libver=("v108", "v108")) as file:
        _write(file, tree)
    data = image.getbuffer()
    data[:_BLOCK] = _header(number, len(data), b"0" * 64)
    data[:_BLOCK] = _header(number, len(data), hashlib.sha256(data).hexdigest().encode())
    return bytes(data)


def is_tree(image: bytes) -> bool:
    """True where a file begins as `to_bytes` begins it."""
    return image.startswith(_MAGIC)


def from_bytes(image: bytes) -> tuple[Tree, int]:
    """The tree and the number of its format; refused before anything is read where the bytes are not those written."""
    import h5py

    header = _HEADER.fullmatch(image[:_BLOCK])
    if header is None:
        raise _damaged(f"its first {_BLOCK} bytes are not those that were written")
    number, length = int(header[1]), int(header[2])
    if len(image) != length:
        raise _damaged(f"it has {len(image)} bytes, and {length} were written")
    digest = hashlib.sha256(_header(number, length, b"0" * 64))
    digest.update(memoryview(image)[_BLOCK:])
    if digest.hexdigest().encode() != header[3]:
        raise _damaged("its bytes have another SHA-256 than those that were written")
    try:
        with h5py.File(io.BytesIO(image), "r") as file:
            return _read(file, Allowance(length), set()), number
    except InputError as error:
        raise _damaged(str(error)) from None
    except Exception as error:  # h5py raises what it likes, and anybody can write bytes with their right SHA-256
        raise _damaged(f"{type(error).__name__}: {error}") from None


def _read(group: Any, allowance: Allowance, before: set[int]) -> Any:
    """Everything in a group, as a dictionary or a list; `before` are addresses of what was read: each stands once."""
    import h5py

    for name in group:
        if group.id.links.get_info(name.encode("utf-8", "surrogateescape")).type != h5py.h5l.TYPE_HARD:
            raise _link(f"{group.name.rstrip('/')}/{name}")
    tree = {name: _value(_attribute(group, name, allowance)) for name in group.attrs}
    for name in group:
        item = group[name]
        address = h5py.h5o.get_info(item.id).addr
        if address in before:
            raise InputError(f"{shown(item.name)} stands in two places")
        before.add(address)
        if isinstance(item, h5py.Dataset):
            check_data(item, allowance)
            tree[name] = _value(_numbers(item), array=True)
        else:
            tree[name] = _read(item, allowance, before)
    return [tree[str(i)] for i in range(tree[_LENGTH])] if _LENGTH in tree else tree


def check_tree(value: Any, at: str = "") -> None:
    """Refuse what cannot stand in a tree: the InputError says where it stands and what may stand there."""
    if isinstance(value, dict):
        for name, part in value.items():
            if not isinstance(name, str) or not name or name in (".", _LENGTH) or "/" in name or "\0" in name:
                raise InputError(f"{at or 'tree'}: {name!r} is no name: a text without '/' is needed")
            check_tree(part, f"{at}/{name}")
    elif isinstance(value, list):
        for i, part in enumerate(value):
            check_tree(part, f"{at}/{i}")
    elif isinstance(value, int | np.integer) and not -(2**63) <= value < 2**63:
        raise InputError(f"{at}: {value} has more than 64 bits and cannot be stored as a number")
    elif not (
        value is None
        or isinstance(value, str | bool | int | float | np.bool_ | np.integer | np.floating)
        or (isinstance(value, np.ndarray) and value.dtype.kind in _NUMBERS)
        or (isinstance(value, tuple) and all(isinstance(text, str) for text in value))
    ):
        raise InputError(
            f"{at}: a {type(value).__name__} cannot be stored; dictionaries, lists, arrays of numbers, texts, tuples "
            "of texts, numbers, bool and None can"
        )


def _damaged(how: str) -> InputError:
    return InputError(f"it is damaged: {how}; take another copy of it, or run the problem again")


def _header(number: int, length: int, digest: bytes) -> bytes:
    text = (
        f"{_MAGIC.decode()}{number}, {length} bytes: {_BLOCK} of text, then HDF5\n"
        f"SHA-256 of the file, with zeros in the place of these 64 digits:\n"
    )
    return (text.encode() + digest + b"\n").ljust(_BLOCK, b"\0")


def _write(group: Any, tree: Tree) -> None:
    import h5py

    for name in sorted(tree):
        value = tree[name]
        if isinstance(value, dict):
            _write(group.create_group(name), value)
        elif isinstance(value, list):
            listed = group.create_group(name)
            listed.attrs[_LENGTH] = len(value)
            _write(listed, {str(i): part for i, part in enumerate(value)})
        elif isinstance(value, np.ndarray):
            group[name] = value
        elif isinstance(value, tuple):
            group[name] = _texts(value)
        elif isinstance(value, str):
            text = _texts((value,))[0]
            (group.attrs if text.nbytes <= _LONGEST_ATTRIBUTE else group)[name] = text
        else:
            group.attrs[name] = h5py.Empty("f8") if value is None else np.asarray(value).item()


def _texts(values: tuple[str, ...]) -> Any:
    """Texts of one length: those of free length are stored as objects, which fewer programs read."""
    import h5py

    encoded = [value.encode("utf-8", "surrogatepass") for value in values]
    return np.array(encoded, dtype=h5py.string_dtype("utf-8", max([1, *map(len, encoded)])))


def _numbers(item: Any) -> Any:
    """All numbers or texts of a data set: what ``item[()]`` gives, in less time."""
    if not item.size or item.dtype.kind == "O":
        return item[()]
    import h5py

    found = np.empty(item.shape, item.dtype)
    item.id.read(h5py.h5s.ALL, h5py.h5s.ALL, found)
    return found


def _value(value: Any, array: bool = False) -> Any:
    import h5py

    if value is None or isinstance(value, h5py.Empty):
        return None
    numbers = np.asarray(value)
    if numbers.dtype.kind not in (*_NUMBERS, "S"):
        raise InputError(f"an array of the type {numbers.dtype} stands in it")
    if numbers.dtype.kind == "S":
        texts = tuple(text.decode("utf-8", "surrogatepass") for text in numbers.ravel().tolist())
        return texts if numbers.ndim else texts[0]
    return numbers if array else numbers.item()


class Allowance:
    """Bytes of memory that are `left` for the numbers of a file of `size` bytes."""

    def __init__(self, size: int) -> None:
        self._size, self.left = size, max(_LEAST, _TIMES * size)

    def take(self, name: str, count: int) -> None:
        """Take away what an array needs, or raise an `InputError` where that is more than is left."""
        if count > self.left:
            raise InputError(
                f"{name} claims {count:.3g} bytes, in a file of {self._size} bytes: it is damaged, or export fewer "
                "channels a file"
            )
        self.left -= count


def check_all_links(file: Any) -> None:
    """Refuse links to other files; a soft link to an object of the file stays, and is not followed."""
    import h5py

    def visit(name: str, link: Any) -> str | None:  # the first text ends the visit
        return name if isinstance(link, h5py.ExternalLink) else None

    found = file.visititems_links(visit)
    if found is not None:
        raise _link(found)


def _link(name: str) -> InputError:
    return InputError(f"{shown(name)} is a link to something else: only what stands in the file itself is read")


def check_data(item: Any, allowance: Allowance) -> None:
    """Refuse a data set whose numbers stand elsewhere, need a library, or would take more memory than is allowed."""
    import h5py

    properties, name = item.id.get_create_plist(), shown(item.name)
    if properties.get_layout() == h5py.h5d.VIRTUAL or properties.get_external_count():
        raise InputError(f"{name} has its numbers in another file: only what stands in the file itself is read")
    filters = {properties.get_filter(at)[0] for at in range(properties.get_nfilters())}
    if filters.difference(_FILTERS):
        raise InputError(f"{name} is packed by a filter that is no part of HDF5: write it without, or with gzip")
    allowance.take(name, math.prod(item.shape or ()) * item.dtype.itemsize)  # an empty one has no shape


def _attribute(group: Any, name: str, allowance: Allowance) -> Any:
    """The array of an attribute, or None where it is empty; refused where it would take more memory than is allowed."""
    stored = group.attrs.get_id(name)
    shape, dtype = stored.shape, stored.dtype  # each read from the file anew
    if shape is None:
        return None
    allowance.take(shown(name), math.prod(shape) * dtype.itemsize)
    refuse((dtype.kind == "O", f"{shown(name)}: an array of the type {dtype} stands in it"))
    found = np.zeros(shape, dtype)
    stored.read(found)
    return found
