"""Results of jobs in a SQLite file, each written whole as it comes, so that an interrupted submission goes on."""

from __future__ import annotations

import contextlib
import json
import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType

import numpy as np

from sysid.errors import InputError
from sysid.jobs.job import Job, JobResult
from sysid.jobs.score import Score
from sysid.results.version import __version__

FILE_NAME = "jobs.sqlite"

_TABLE = """CREATE TABLE IF NOT EXISTS jobs (
    job TEXT PRIMARY KEY, success INTEGER NOT NULL, message TEXT NOT NULL, x BLOB NOT NULL, residual REAL, score TEXT
)"""


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
        """What is there of the jobs, by index."""
        with self._told():
            told = self._file.execute("SELECT job, success, message, x, residual, score FROM jobs")
            rows = {row[0]: row[1:] for row in told}
        return {
            index: JobResult(
                index, self._seeds[index], bool(success), message, np.frombuffer(x), np.nan if left is None else left,
                None if score is None else Score(**json.loads(score)),
            )
            for index, key in self._keys.items()
            if key in rows
            for success, message, x, left, score in (rows[key],)
        }  # fmt: skip

    def add(self, result: JobResult) -> None:
        """Write a result; it is on the disk when this returns."""
        x, left = np.ascontiguousarray(result.x, dtype=float).tobytes(), float(result.residual)
        score = None if result.score is None else json.dumps(asdict(result.score))
        row = (self._keys[result.index], int(result.success), result.message, x, left, score)
        with self._told(), self._file:
            self._file.execute("INSERT OR REPLACE INTO jobs VALUES (?, ?, ?, ?, ?, ?)", row)

    def __enter__(self) -> Ledger:
        with self._told():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(self.path)
            try:
                self._file.execute(_TABLE)
                if "score" not in {row[1] for row in self._file.execute("PRAGMA table_info(jobs)")}:
                    self._file.execute("ALTER TABLE jobs ADD COLUMN score TEXT")  # made before there were scores
            except sqlite3.Error:
                self._file.close()
                raise
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except (OSError, sqlite3.Error) as error:
            raise InputError(f"the ledger of jobs {self.path} cannot be used: {error}") from error


def _key(job: Job) -> str:
    start = job.recipe.start if job.start == 0 else None
    key = [__version__, {**job.recipe.to_tree(), "start": start}, job.start, job.source]
    if job.strategy:
        key += [job.strategy, repr(job.change)]
    return json.dumps([*key, job.draw] if job.draw else key, sort_keys=True)
