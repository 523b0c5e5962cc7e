"""Submit refinement jobs, keep their results in a ledger, and hand them out as they come.

The ledger is a SQLite file in which each result is written whole as it comes: an interrupted submission goes on.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import itertools
import json
import sqlite3
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from types import TracebackType
from typing import Any

from sysid import catalogue
from sysid.errors import InputError, numbers, refuse, sequence, whole_number
from sysid.jobs.changes import Change, check_drawable
from sysid.jobs.engine import checked, each
from sysid.jobs.job import Job, JobResult, run, without_result
from sysid.jobs.score import Score
from sysid.results.identification import Recipe
from sysid.results.version import __version__
from sysid.search.auto import NAMED, NAMES

FILE_NAME = "jobs.sqlite"

_COLUMNS = "results (job TEXT PRIMARY KEY, result TEXT NOT NULL, sha256 TEXT NOT NULL)"
_FOREIGN = (sqlite3.SQLITE_ATTACH, sqlite3.SQLITE_FUNCTION)  # what no statement of a ledger does


class Ledger:
    """Results of some jobs, in a folder, which is made where there is none.

    A job is known by sysid's version, its recipe, its start, draw or change, and `Job.source` (see `submit`):
    where one of these differs it is another job. The file is open inside ``with`` alone. An InputError where the folder
    cannot be written, or its file is no ledger or damaged; later too, such as on a full disk.
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


def submit(
    recipe: Recipe | Sequence[Recipe],
    *,
    starts: int = 1,
    draws: int = 0,
    changes: Sequence[Change | None] = (),
    strategy: str = "",
    executor: Executor | Callable[[], Executor] | None = None,
    out: str | Path | None = None,
) -> Generator[JobResult, None, None]:
    """Refine each recipe's problem from several starts, by gradients, or identify it whole.

    Parameters
    ----------
    recipe : Recipe or sequence of Recipe
        A problem module with what is passed to its ``problem()``. `Recipe.start` is where the first start begins; the
        others are fresh points of the search space, by the recipe's ``rng``.
    starts : int
        Of each recipe.
    draws : int
        In the place of starts: fits of records that the structure at `Recipe.start` would have given, with noise of the
        size that was stated or found, drawn anew for each. With ``strategy="modal"``, of an answer that tells no
        unknowns: whole identifications, of as many modes as the answer of the records themselves.
    changes : sequence of Band, WithoutRun, WithoutSensor, NumberOfModes or None
        In the place of starts: whole identifications of the problem as each changes it; None leaves it as it is.
    strategy : str
        Of whole identifications, as in `sysid.identify`; without changes the problem of each recipe is identified as it
        is. The seed of the search is ``Recipe.rng``. "auto", the default of changes, fits these from `Recipe.start`,
        where there is one, and matrices do not follow from modes.
    executor : Executor or callable, optional
        None runs the jobs in this process. ``sysid.jobs.processes(4)`` makes pools of four processes, a new one where
        a worker died; a function of your own that makes an executor does as well, such as one that gives
        ``dask.distributed.Client(address).get_executor()``. An executor itself is used as it is: what its workers lose
        is reported without a result. IPOPT bears no threads: a pool of threads is refused.
    out : str or Path, optional
        Folder of the ledger ``jobs.sqlite``: results that stand there are not computed again, as long as sysid's
        version, the texts of the module and of what it imports from beside itself, and the data are what they were: of
        a data file its bytes, of a folder the names, sizes and times of its files (those in `out` do not count). What
        the module reads or imports from elsewhere is not looked at: after a change there, give another folder.

    Returns
    -------
    generator of JobResult
        As they come; jobs are numbered recipe by recipe, start by start (or draw, or change). The result of a job does
        not depend on where it runs, nor on how many run beside it. Its ``close()`` gives up what is left.

    Raises
    ------
    InputError
        Where a recipe does not make a problem, or the folder cannot be written. At once, before any job runs: each
        distinct recipe is built here once, in a second or two, whatever its start.
    """
    recipes = list(recipe) if isinstance(recipe, Sequence) else [recipe]
    others = [type(one).__name__ for one in recipes if not isinstance(one, Recipe)]
    refuse(
        (not recipes, "submit was given no recipe"),
        (
            others,
            f"submit takes recipes, not a {', '.join(others[:1])}: a job is rebuilt where it runs, so save the "
            "problem as a module, problem.py, and give sysid.Recipe('problem.py')",
        ),
    )
    starts, draws = whole_number("starts", starts, at_least=1), whole_number("draws", draws, at_least=0)
    lacking = draws and (starts > 1 or (not strategy and any(one.start is None for one in recipes)))
    wanted = "draws need Recipe.start, the unknowns that were identified, or strategy='modal', and exclude starts"
    refuse((lacking or (draws and strategy not in ("", "auto", "modal")), wanted))
    if changes != ():
        changes = sequence("changes", changes, "a list of Band, WithoutRun, WithoutSensor, NumberOfModes or None")
    by = _strategy(strategy, changes, starts > 1 or (draws > 0 and changes != ()))
    if isinstance(executor, Executor) or not (executor is None or callable(executor)):
        checked(executor)
    jobs: list[Job] = []
    index = itertools.count()
    folder = None if out is None else Path(out).absolute()
    for one, source in zip(recipes, _sources(recipes, draws > 0, folder), strict=True):
        rooted = _rooted(one)
        if draws:
            jobs += [Job(next(index), rooted, 0, source, draw=k + 1, strategy=by) for k in range(draws)]
        elif by:
            jobs += [Job(next(index), rooted, 0, source, strategy=by, change=change) for change in changes or (None,)]
        else:
            jobs += [Job(next(index), rooted, k, source) for k in range(starts)]
    ledger = None if folder is None else Ledger(folder, jobs)
    with ledger or nullcontext():  # one that cannot be written is told now; it is open while there are results to come
        pass
    return _results(jobs, executor, ledger)


def _strategy(strategy: str, changes: Sequence[Change | None], others: bool) -> str:
    """The strategy of whole identifications; empty where none are asked for."""
    wrong = [type(change).__name__ for change in changes if not isinstance(change, Change | None)]
    refuse(
        (wrong, f"changes holds a {', '.join(wrong[:1])}; give Band, WithoutRun, WithoutSensor or NumberOfModes"),
        (others and (changes or strategy), "give changes or a strategy without starts, and changes without draws"),
        (strategy not in ("", "auto", *NAMED), f"strategy {strategy!r} is unknown; give one of {NAMES}"),
    )
    return strategy or ("auto" if changes else "")


def _sources(recipes: list[Recipe], drawn: bool, out: Path | None) -> Iterator[str]:
    """SHA-256 of what each recipe's problem is made from; building it first tells what is wrong before any job runs."""
    texts: dict[Recipe, str] = {}
    of_data = functools.cache(functools.partial(_data, out=out))
    for recipe in recipes:
        bare = replace(recipe, start=None)
        if bare not in texts:
            problem, files = catalogue.built(bare)
            if drawn:
                check_drawable(problem)
            texts[bare] = catalogue.digest(files)
        yield hashlib.sha256(repr((texts[bare], of_data(recipe.data))).encode()).hexdigest()


def _data(path: str | None, out: Path | None) -> str | list[tuple[str, int, int]]:
    """Digest that tells the contents of a data file or folder from others."""
    if path is None:
        return ""
    place = Path(path).resolve()
    if place.is_file():
        return catalogue.digest([place])
    apart = None if out is None else out.resolve()
    files = [file for file in sorted(place.rglob("*")) if file.is_file() and apart not in file.parents]
    return [(str(file.relative_to(place)), file.stat().st_size, file.stat().st_mtime_ns) for file in files]


def _rooted(recipe: Recipe) -> Recipe:
    """The same recipe for a worker that stands in another folder."""
    file = catalogue.file_of(recipe.module)
    module, data = recipe.module, None if recipe.data is None else str(Path(recipe.data).absolute())
    if file is not None and file.parent != catalogue.bundled_folder():
        module = str(file.absolute())
    return replace(recipe, module=module, data=data)


def _results(
    jobs: list[Job], executor: Executor | Callable[[], Executor] | None, ledger: Ledger | None
) -> Generator[JobResult, None, None]:
    with ledger or nullcontext():
        known = {} if ledger is None else ledger.results()
        yield from known.values()
        left = [job for job in jobs if job.index not in known]
        for result in each(run, left, executor, without_result):
            if ledger is not None and result.has_result:
                ledger.add(result)
            yield result
