"""Exit statuses, and Ctrl-C while Python still imports what the ``sysid`` command needs: one line, status 130.

The last acts from when this module is imported, which is the first thing that the package does.
"""

from __future__ import annotations

import os
import signal
import sys
from itertools import pairwise
from pathlib import PurePath
from typing import NoReturn

SUCCESS, NOT_REACHED, MISTAKE, BUG, INTERRUPTED = 0, 1, 2, 70, 130  # as `sysid.cli.main` says
NOTHING_SAVED = "interrupted; nothing was saved"


def is_over() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _is_command() -> bool:
    """True where this process was started as ``sysid`` or ``python -m sysid``; processes that it starts are not."""
    name, given = sys.argv[0] if sys.argv else "", sys.orig_argv[1:]
    if name == "-m":  # so it is called until its module is found
        return "-msysid" in given or ("-m", "sysid") in pairwise(given)
    return name in given and PurePath(name).stem == "sysid"


def _end(number: int, frame: object) -> NoReturn:
    """End the process: an exception would leave the imports as a traceback, or be lost in compiled code."""
    try:
        os.write(2, f"sysid: {NOTHING_SAVED}\n".encode())
    finally:
        os._exit(INTERRUPTED)


if _is_command() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, _end)
