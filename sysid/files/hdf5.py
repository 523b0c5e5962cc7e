"""Safe reading of HDF5 files of others: numbers and texts of their own, and no more than memory bears.

HDF5 can take the numbers of a data set from any file of the machine (external storage, links to other files, virtual
data sets), unpack a few bytes to terabytes, and load a library for a filter that it does not know. All of it is
refused before a number is read.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sysid.errors import InputError, refuse, shown
from sysid.files.allowance import Allowance

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
