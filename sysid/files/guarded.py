"""Files of somebody else's making, read in a process of their own.

A parser that crashes, hangs or fills the memory there takes nothing with it.
"""

from __future__ import annotations

import contextlib
import importlib
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

from sysid.errors import InputError
from sysid.files.tree import Tree, from_bytes, to_bytes

_SECONDS = 30.0  # imports included, on a loaded machine too
_PROCESSOR_SECONDS = 3  # of the reader itself
_MEMORY = 2**32  # bytes
# With the modules that this process finds: a file of the user's in the working folder must not stand for one of them.
_CHILD = f"import sys; sys.path[:] = sys.argv.pop(1).split('|'); from {__name__} import give; give(*sys.argv[1:])"
_REFUSED = 3  # exit status: what was wrong is on standard error


def guarded(reader: str, path: Path, seconds: float = _SECONDS) -> Tree:
    """What a function of the package gives of a file, called in another process.

    Parameters
    ----------
    reader : str
        ``module:function``; the function takes a Path and gives a tree, see `sysid.files.tree`.
    path : Path
    seconds : float
        After which the other process is ended.

    Raises
    ------
    InputError
        What the function raised; or that the process crashed, took too long or too much memory.
    """
    command = [sys.executable, "-W", "ignore", "-c", _CHILD, "|".join(sys.path), reader, str(path.absolute())]
    try:
        done = subprocess.run(command, capture_output=True, timeout=seconds, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        raise InputError(f"it is damaged: reading it takes more than {seconds:g} s") from None
    if done.returncode == _REFUSED:
        raise InputError(done.stderr.decode("utf-8", "replace").strip())
    if done.returncode < 0:
        name = signal.Signals(-done.returncode).name
        if name == "SIGXCPU":
            raise InputError(f"it is damaged: reading it takes more than {_PROCESSOR_SECONDS} s of a processor")
        raise InputError(f"it is damaged: the library that reads it crashed ({name})")
    if done.returncode:
        last = done.stderr.decode("utf-8", "replace").strip().rpartition("\n")[2]
        raise InputError(f"it is damaged ({last or f'its reader ended with {done.returncode}'})")
    return from_bytes(done.stdout)[0]


def give(reader: str, path: str) -> None:
    """Write the tree that a reader gives to standard output: what the other process does."""
    module, _, name = reader.partition(":")
    read = getattr(importlib.import_module(module), name)
    with contextlib.suppress(ImportError, OSError, ValueError):  # not every system has such limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        until = math.ceil(time.process_time()) + _PROCESSOR_SECONDS
        resource.setrlimit(resource.RLIMIT_CPU, (until, until + 1))
    try:
        image = to_bytes(read(Path(path)), 0)
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(_REFUSED)
    sys.stdout.buffer.write(image)
