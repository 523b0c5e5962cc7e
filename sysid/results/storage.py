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
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from sysid.errors import InputError, path_of, refuse
from sysid.files.tree import Tree, from_bytes, is_tree, to_bytes
from sysid.results.version import __version__

CONTENT = "sysid identification"
FORMAT = 5  # rises with every change that an older sysid could not read
FILE_NAME = "result.h5"

_ANEW = "make it anew by 'sysid run PROBLEM'"
_HDF5 = b"\x89HDF\r\n\x1a\n"  # formats 1 and 2 began with it, without a SHA-256

_SUFFIXES = (".h5", ".hdf5")

T = TypeVar("T")
LOCK_NAME = ".sysid.lock"


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
    refuse((not there, f"no result at {source}: give the .h5 file that 'sysid run' wrote, or its folder"))
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
    earlier = f"it is no result of this sysid, but of one before format 3, or of another program; {_ANEW}"
    refuse(
        (image.startswith(_HDF5), earlier),
        (not is_tree(image), "it is not a result of sysid, or its first bytes are damaged"),
    )
    tree, number = from_bytes(image)
    version, content, this = tree.get("sysid_version"), tree.get("content"), f"this one reads format {FORMAT}"
    refuse(
        (number > FORMAT, f"it has format {number} (sysid {version}), and {this}: a later sysid is needed"),
        (content != CONTENT, f"it holds a {content}, not a {CONTENT}"),
        (number < FORMAT, f"it has format {number}, of an earlier sysid, and {this}; {_ANEW}"),
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


if sys.platform == "win32":
    import msvcrt

    def _lock(file: int) -> None:
        os.lseek(file, 1024, os.SEEK_SET)  # behind the owner, which others read
        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        except OSError as error:  # all file systems have locks there
            raise PermissionError from error

    def _release(file: int, held: Path) -> None:
        """Let the file go, then take it away, which is not possible while anybody has it open."""
        os.close(file)
        with contextlib.suppress(OSError):
            held.unlink()
else:
    import fcntl

    def _lock(file: int) -> None:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)

    def _release(file: int, held: Path) -> None:
        """Take the file away, then let it go: in the other order it could be the next one's."""
        held.unlink(missing_ok=True)
        os.close(file)


class _HeldError(Exception):
    """Another process has the lock; the argument is its record (see `_process_record`), empty where it is not known."""


@contextlib.contextmanager
def alone(lock: Path, what: str, remedy: str) -> Iterator[None]:
    """Hold a lock on a file; it is gone at the end, with the folders that were made for it if nothing else is in them.

    The operating system's lock on an open file ends with the process, after a kill too. Where the file system has none
    (Lustre, for example), a file names its owner, and is stale where that has ended. Raises InputError, in which
    `what` is in use and `remedy` tells what to do, where another process, or another thread of this one, holds it, or
    the file cannot be written.
    """
    missing = missing_folders(lock.parent)
    try:
        try:
            file, held = _acquired(lock)
        except _HeldError as other:
            host, pid, _ = [*str(other).split(" "), "", ""][:3]
            owner = f" (process {pid} on {host})" * bool(pid)
            raise InputError(f"{what} is in use by another run{owner}: {remedy}") from None
        except OSError as error:
            raise InputError(f"{what} cannot be written: {error.strerror or error}") from error
        try:
            yield
        finally:
            _release(file, held)
    finally:
        remove_empty(missing)


def _acquired(lock: Path) -> tuple[int, Path]:
    """The open file that is locked, and the file to take away: that one, or where there are no locks the owner's."""
    while True:
        file = _opened(lock)
        try:
            try:
                _lock(file)
            except (BlockingIOError, PermissionError):
                raise _HeldError(os.read(file, 200).decode(errors="replace")) from None
            except OSError:
                lock.unlink(missing_ok=True)
                return file, _named(lock)
            # The process before takes its file away while it holds it: then this is a lock on nothing.
            if _is_same(file, lock):
                os.truncate(file, 0)
                os.write(file, _process_record().encode())
                return file, lock
        except BaseException:
            os.close(file)
            raise
        os.close(file)


def _opened(lock: Path, tries: int = 100) -> int:
    """The file, made with its folders; again where the process before takes its folders away in between.

    A try fails only where that happens in the microseconds between two calls.
    """
    try:
        lock.parent.mkdir(parents=True, exist_ok=True)
        return os.open(lock, os.O_RDWR | os.O_CREAT, 0o666)
    except (FileNotFoundError, FileExistsError):
        if not tries:
            raise
        return _opened(lock, tries - 1)


def _is_same(file: int, lock: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(file), lock.stat())
    except FileNotFoundError:
        return False


# -- where the file system has no locks ---------------------------------------------------------


def _named(lock: Path) -> Path:
    """The file beside `lock` that now names this process as the owner; one whose owner has ended is taken over."""
    named = lock.with_name(f"{lock.name}.owner")
    aside = lock.with_name(f"{lock.name}.{secrets.token_hex(4)}")
    try:
        while True:
            with contextlib.suppress(FileNotFoundError, FileExistsError):  # owner or folder are just being taken away
                named.parent.mkdir(parents=True, exist_ok=True)
                aside.write_text(_process_record())
                with contextlib.suppress(FileExistsError):
                    os.link(aside, named)  # in one step with what stands in it
                    return named
                there = named.read_text()
                if _is_alive(there):
                    raise _HeldError(there)
                named.replace(aside)
                if aside.read_text() != there:  # another process took it over in between: give it back
                    aside.replace(named)
    finally:
        aside.unlink(missing_ok=True)


def _host() -> str:
    """Name of this machine."""
    import socket  # which takes some milliseconds, and is needed where something is written

    return socket.gethostname()


def _process_record() -> str:
    """Host, process and when it began, as one line."""
    return f"{_host()} {os.getpid()} {_start_of_process(os.getpid())}"


def _is_alive(record: str) -> bool:
    """True where the process of a record is there; one on another host is taken to be."""
    host, pid, started = record.split(" ")
    if host != _host():
        return True
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # another user's
        pass
    return _start_of_process(int(pid)) == started


def _start_of_process(pid: int) -> str:
    """When a process began, in clock ticks since the machine did; empty where the system does not tell."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except OSError:
        return ""
