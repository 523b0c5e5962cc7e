"""Results of jobs in a SQLite file, each written whole as it comes, so that an interrupted submission goes on."""

from __future__ import annotations

import contextlib
import hashlib
import json
import sqlite3
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType
from typing import Any

from sysid.errors import InputError, numbers
from sysid.jobs.job import Job, JobResult
from sysid.jobs.score import Score
from sysid.results.version import __version__

FILE_NAME = "jobs.sqlite"

_COLUMNS = "results (job TEXT PRIMARY KEY, result TEXT NOT NULL, sha256 TEXT NOT NULL)"
_FOREIGN = (sqlite3.SQLITE_ATTACH, sqlite3.SQLITE_FUNCTION)  # what no statement of a ledger does


class Ledger:
    """Results of some jobs, in a folder.

    A job is known by sysid's version, its recipe, its start, draw or change, and `Job.source` (see `submit`):
    where one of these differs it is another job. The file is open inside ``with`` alone.

    Parameters
    ----------
    folder : Path
        It is made where there is none.
    jobs : sequence of Job

    Raises
    ------
    InputError
        Where the folder cannot be written, or its file is no ledger or damaged; later too, such as on a full disk.
    """

    def __init__(self, folder: Path, jobs: Sequence[Job]) -> None:
        self.path = folder / FILE_NAME
        self._keys = {job.index: _key(job) for job in jobs}
        self._seeds = {job.index: job.seed for job in jobs}

    def results(self) -> dict[int, JobResult]:
        """Results of the jobs that are there, by index; a damaged one counts as none, with a warning."""
        with self._sqlite_errors_named():
            rows = {row[0]: row[1:] for row in self._file.execute("SELECT job, result, sha256 FROM results")}
        wanted = {index: rows[key] for index, key in self._keys.items() if key in rows}
        found = {index: self._result(index, *row) for index, row in wanted.items()}
        sound = {index: result for index, result in found.items() if result is not None}
        if len(sound) < len(wanted):
            share = f"{len(wanted) - len(sound)} of {len(wanted)}"
            warnings.warn(f"{share} results in {self.path} are damaged: computed again", stacklevel=3)
        return sound

    def _result(self, index: int, text: Any, digest: Any) -> JobResult | None:
        """The result in a row; None where it is damaged, or was never one."""
        if _digest(text) != digest:
            return None
        try:
            success, message, x, residual, score = json.loads(text)
            stored_score = None if score is None else Score(**score)
            unknowns = numbers("x", x)
            if not (isinstance(success, bool) and isinstance(message, str) and unknowns.ndim == 1):
                return None
            return JobResult(index, self._seeds[index], success, message, unknowns, float(residual), stored_score)
        except (ValueError, TypeError, RecursionError):  # anybody can write a row with its right SHA-256
            return None

    def add(self, result: JobResult) -> None:
        """Write a result; it is on the disk when this returns."""
        score = None if result.score is None else asdict(result.score)
        text = json.dumps([bool(result.success), result.message, result.x.tolist(), float(result.residual), score])
        with self._sqlite_errors_named(), self._file:
            row = (self._keys[result.index], text, _digest(text))
            self._file.execute("INSERT OR REPLACE INTO results VALUES (?, ?, ?)", row)

    def __enter__(self) -> Ledger:
        with self._sqlite_errors_named():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(self.path)
            try:
                self._prepare()
            except BaseException:
                self._file.close()
                raise
        return self

    def _prepare(self) -> None:
        """Make the table where there is none.

        A file that holds anything else is not used: of a view or a trigger, which run SQL of their own, and of other
        tables, which are somebody else's.
        """
        deny, allow = sqlite3.SQLITE_DENY, sqlite3.SQLITE_OK
        self._file.set_authorizer(lambda action, *_: deny if action in _FOREIGN else allow)
        self._file.execute("PRAGMA trusted_schema = OFF")
        tables = [sql for (sql,) in self._file.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL")]
        if not tables:
            self._file.execute(f"CREATE TABLE IF NOT EXISTS {_COLUMNS}")
        elif tables != [f"CREATE TABLE {_COLUMNS}"]:
            raise InputError(f"{self.path} is no ledger of jobs of this sysid: take it away, or give another folder")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()

    @contextlib.contextmanager
    def _sqlite_errors_named(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error, UnicodeDecodeError) as error:  # the last where SQLite quotes a damaged name
            raise InputError(f"the ledger of jobs {self.path} cannot be used: {error}") from error


def _digest(text: object) -> str:
    return hashlib.sha256(str(text).encode(errors="replace")).hexdigest()


def _key(job: Job) -> str:
    start = job.recipe.start if job.start == 0 else None
    key = [__version__, {**job.recipe.to_tree(), "start": start}, job.start, job.source]
    if job.strategy:
        key += [job.strategy, repr(job.change)]
    return json.dumps([*key, job.draw] if job.draw else key, sort_keys=True)
