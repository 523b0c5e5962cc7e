"""Journal of a search, part by part, so that it goes on from there after its process has ended.

A search repeats bit for bit with the same seed. So it is enough to keep where its long parts ended, and the state of
the one that runs: a resumed search takes the same way, and reads these in place of running them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sysid.errors import InputError

Tree = dict[str, Any]

EVERY = 3.0  # s between two writings
_SHARE = 0.05  # of the time that writing may take


class Journal:
    """The long parts of a search in their order.

    Parameters
    ----------
    write : callable, optional
        Keeps the entries that it is given; without it nothing is kept.
    entries : dict, optional
        Those of an earlier run of the same search: name and content of each part, by its number as a text.
    every : float
        s between two writings, at least; more where writing takes long.
    """

    def __init__(
        self, write: Callable[[Tree], object] | None = None, entries: Tree | None = None, every: float = EVERY
    ) -> None:
        self.entries = dict(entries or {})
        self._write, self._every = write, every
        self._next, self._written, self._took = 0, time.perf_counter(), 0.0
        self._unwritten = False

    def part(self, name: str) -> Part:
        """Begin the next part.

        Raises
        ------
        InputError
            Where the earlier run had another one here.
        """
        number, self._next = str(self._next), self._next + 1
        found = self.entries.get(number)
        if found is not None and found["part"] != name:
            raise InputError(
                f"the unfinished run had part {found['part']!r} where this one has {name!r}: it was of another search"
            )
        return Part(self, number, name, None if found is None else found["content"])

    def keep(self, number: str, name: str, content: Callable[[], Tree], *, at_once: bool = False) -> None:
        """Take the content of a part, where it is time to write, or anyway."""
        due = time.perf_counter() - self._written > max(self._every, self._took / _SHARE)
        if self._write is None or not (due or at_once):
            return
        # What came after an older state of this part does not follow from this one.
        self.entries = {key: entry for key, entry in self.entries.items() if int(key) < int(number)}
        self.entries[number] = {"part": name, "content": content()}
        self._unwritten = True
        if due:
            self.flush()

    def flush(self) -> None:
        """Write what is not written."""
        if self._write is None or not self._unwritten:
            return
        start = time.perf_counter()
        self._write(self.entries)
        self._written = time.perf_counter()
        self._took, self._unwritten = self._written - start, False


class Part:
    """One part of a search.

    Attributes
    ----------
    found : dict or None
        What an earlier run kept of it.
    """

    def __init__(self, journal: Journal, number: str, name: str, found: Tree | None) -> None:
        self._journal, self._number, self._name, self.found = journal, number, name, found

    def running(self, content: Callable[[], Tree]) -> None:
        """Keep its present state, where it is time to."""
        self._journal.keep(self._number, self._name, content)

    def ended(self, content: Callable[[], Tree]) -> None:
        """Keep its end, or its state where it is stopped."""
        self._journal.keep(self._number, self._name, content, at_once=True)
