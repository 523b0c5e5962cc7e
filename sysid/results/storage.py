"""Results on disk: one HDF5 file an identification, numbers and text only, with the SHA-256 of its bytes.

::

    first 512 bytes    format, length and SHA-256 of the file, as text
    /                  content, format, sysid_version, strategy, seed, success, message, ...   (attributes)
    ├── x              the unknowns
    ├── structure      mass, stiffness, damping_ratios | damping_matrix, recovery, rigid_body, sensors
    ├── problem        goal; measurement, validation/0, validation/1, ..., reference
    │   └── given      mass, stiffness, damping: a model's kind and fields, numbers, or an expression's number;
    │                  residuals, constraints, misfit, healing; variables, and CasADi's text of all expressions
    ├── history        residual after each phase, both curves, states, log
    └── recipe         module, data, rng, parameters, start
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
from sysid.results.old_formats import CONTENT, SIGNATURE, tree_of, with_against
from sysid.results.version import __version__

FORMAT = 3  # rises where an older sysid could not read the file: since 3 it is a tree with a SHA-256
FILE_NAME = "result.h5"

_SUFFIXES = (".h5", ".hdf5")

T = TypeVar("T")


def write(tree: Tree, path: str | Path) -> Path:
    """Write the tree of a result to an HDF5 file, whole or not at all; path and errors as in `Identification.save`."""
    target = file_or_folder(path, FILE_NAME, _SUFFIXES)
    # Built in memory: on a full disk HDF5 loses the error when it closes, or takes the process down.
    image = to_bytes({"content": CONTENT, "format": FORMAT, "sysid_version": __version__, **tree}, FORMAT)
    with atomically(target) as temporary:
        temporary.write_bytes(image)
    return target


def read(path: str | Path, build: Callable[[Tree], T]) -> T:
    """What `build` makes of the tree that `write` wrote, or an earlier sysid; path and errors as in `load`.

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
    except Exception as error:  # what a damaged file of an old format leads to has no end of kinds
        raise InputError(f"{source} cannot be read: it is damaged ({type(error).__name__}: {error})") from error


def _tree(source: Path) -> Tree:
    """The tree of a file, in this format whatever the file's."""
    image = source.read_bytes()
    if not is_tree(image):
        if not image.startswith(SIGNATURE):
            raise InputError("it is not a result of sysid, or its first bytes are damaged")
        return with_against(tree_of(source))
    tree, number = from_bytes(image)
    if number > FORMAT:
        raise InputError(
            f"it has format {number} (sysid {tree.get('sysid_version')}), and this one reads up to {FORMAT}: a later "
            "sysid is needed"
        )
    if tree["content"] != CONTENT:
        raise InputError(f"it holds a {tree['content']}, not a {CONTENT}")
    return tree if "against" in tree else with_against(tree)


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
