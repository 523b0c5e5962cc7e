"""One process at a time in a folder: a lock that ends with its process, however that ends."""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

from sysid.errors import InputError
from sysid.results.storage import missing_folders, remove_empty

FILE_NAME = ".sysid.lock"


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
    """Hold a lock; it is gone at the end, with the folders that were made for it if nothing else is in them.

    The operating system's lock on an open file ends with the process, after a kill too. Where the file system has
    none (Lustre, for example), a file names its owner, and is stale where that has ended.

    Parameters
    ----------
    lock : Path
        The file that is locked.
    what : str
        What is used, for the message.
    remedy : str
        What to do where another process holds it, for the message.

    Raises
    ------
    InputError
        Where another process, or another thread of this one, holds it, or the file cannot be written.
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


def _process_record() -> str:
    """Host, process and when it began, as one line."""
    return f"{socket.gethostname()} {os.getpid()} {_start_of_process(os.getpid())}"


def _is_alive(record: str) -> bool:
    """True where the process of a record is there; one on another host is taken to be."""
    host, pid, started = record.split(" ")
    if host != socket.gethostname():
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
