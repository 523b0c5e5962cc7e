"""Results on disk: one HDF5 file an identification, numbers and text only, with the SHA-256 of its bytes.

::

    first 512 bytes    format, length and SHA-256 of the file, as text
    /                  content, format, sysid_version, strategy, seed, success, message, ...   (attributes)
    ├── x              the unknowns
    ├── structure      mass, stiffness, damping_ratios | damping_matrix, recovery, rigid_body, sensors
    ├── problem        goal; measurement, validation/0, validation/1, ..., reference
    │   └── given      mass, stiffness, damping: a model's kind and fields, numbers, or an expression's number;
    │                  residuals, constraints, misfit, healing; variables, and the operations of all expressions
    ├── history        residual after each phase, both curves, states, log
    ├── recipe         module, data, rng, parameters, start
    └── readings       what summary, report and export ask of a problem that the file does not hold whole
"""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from sysid.errors import InputError, path_of
from sysid.files.tree import Tree, from_bytes, is_tree, to_bytes
from sysid.results.version import __version__

CONTENT = "sysid identification"
FORMAT = 5  # rises with every change that an older sysid could not read
FILE_NAME = "result.h5"

_ANEW = "make it anew by 'sysid run PROBLEM'"
_HDF5 = b"\x89HDF\r\n\x1a\n"  # formats 1 and 2 began with it, without a SHA-256

_SUFFIXES = (".h5", ".hdf5")

T = TypeVar("T")


def write_tree(tree: Tree, path: str | Path) -> Path:
    """Write the tree of a result to an HDF5 file, whole or not at all; path and errors as in `Identification.save`."""
    target = file_or_folder(path, FILE_NAME, _SUFFIXES)
    # Built in memory: on a full disk HDF5 loses the error when it closes, or takes the process down.
    image = to_bytes({"content": CONTENT, "format": FORMAT, "sysid_version": __version__, **tree}, FORMAT)
    with atomically(target) as temporary:
        temporary.write_bytes(image)
    return target


def read_tree(path: str | Path, build: Callable[[Tree], T]) -> T:
    """Object that `build` makes of the tree that `write` wrote; path and errors as in `load`.

    What is wrong with `build`'s tree is an error of the file.
    """
    given = path_of("path", path)
    try:
        source = given / FILE_NAME if given.is_dir() else given
        there = source.is_file()
    except OSError as error:  # such as a name that is too long
        raise InputError(f"{given} cannot be read: {error.strerror or error}") from None
    if not there:
        raise InputError(f"no result at {source}: give the .h5 file that 'sysid run' wrote, or its folder")
    try:
        return build(_tree(source))
    except InputError as error:
        raise InputError(f"{source} cannot be read: {error}") from error
    except OSError as error:
        raise InputError(f"{source} cannot be read: {error.strerror or error}") from error
    except Exception as error:  # what a tree of another program leads to has no end of kinds
        raise InputError(f"{source} cannot be read: it is damaged ({type(error).__name__}: {error})") from error


def _tree(source: Path) -> Tree:
    """The tree of a file."""
    image = source.read_bytes()
    if image.startswith(_HDF5):
        raise InputError(f"it is no result of this sysid, but of one before format 3, or of another program; {_ANEW}")
    if not is_tree(image):
        raise InputError("it is not a result of sysid, or its first bytes are damaged")
    tree, number = from_bytes(image)
    if number > FORMAT:
        raise InputError(
            f"it has format {number} (sysid {tree.get('sysid_version')}), and this one reads format {FORMAT}: a later "
            "sysid is needed"
        )
    if tree["content"] != CONTENT:
        raise InputError(f"it holds a {tree['content']}, not a {CONTENT}")
    if number < FORMAT:
        raise InputError(
            f"it has format {number}, of an earlier sysid, in which expressions could hold code, and this one reads "
            f"format {FORMAT}; {_ANEW}"
        )
    return tree


def file_or_folder(path: str | Path, name: str, suffixes: Sequence[str]) -> Path:
    """Give the file to write: `path` where it ends in one of `suffixes`, the usual one first, else `name` in it.

    Raises
    ------
    InputError
        Where `path` is a file with another ending, which is somebody else's.
    """
    target = path_of("path", path)
    if target.suffix.lower() in suffixes:
        return target
    if target.is_file():
        raise InputError(f"{target} is some other file: give a name that ends in {suffixes[0]}, or a folder")
    return target / name


@contextlib.contextmanager
def atomically(path: Path) -> Iterator[Path]:
    """Give a temporary file beside `path`, whose folder is made; it takes its place at the end, or vanishes on failure.

    Raises
    ------
    InputError
        Where `path` cannot be written.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        # A power cut must not leave the new name with no content behind it.
        with temporary.open("rb+") as written:
            os.fsync(written.fileno())
        os.replace(temporary, path)  # noqa: PTH105 - the atomic one; its name says so
    except BaseException as error:  # Ctrl-C too leaves nothing half-written
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise InputError(f"{path} cannot be written: {error.strerror or error}") from error
        raise


def unfinished_writings(path: Path) -> list[Path]:
    """Give the temporary files of `atomically` that are left where a process was killed while it wrote."""
    return list(path.parent.glob(f".{path.name}.*.tmp"))


def missing_folders(folder: Path) -> list[Path]:
    """Give those of a folder and the folders around it that do not exist, the innermost first."""
    return [place for place in (folder, *folder.parents) if not place.exists()]


def remove_empty(folders: Sequence[Path]) -> None:
    """Take folders away until one is not empty."""
    with contextlib.suppress(OSError):
        for place in folders:
            place.rmdir()
