"""Every cell of the table of mistakes: whether the first sentence names the actual cause, and right tests are left."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Iterator
from itertools import product
from typing import NamedTuple

import numpy as np

import sysid
from benchmarks.line import Line, above, below
from benchmarks.mistakes.wrong_tests import CAUSES, FORMS, RECORDS, SPECTRA, problem, right, truth
from benchmarks.modal.spread import spread

SECONDS = 10.0
EQUALLY = 1.02  # residual of the other right model over that of the true one on the right records
ANY = "|".join(f"(?:{cause.named})" for cause in CAUSES.values())  # what accuses a test of any mistake
MISTAKES = {cause.finding for cause in CAUSES.values()} - {""}
RIGHT = "right"


class Cell(NamedTuple):
    """A cause (or "right"), a form of the model, a kind of data, whether a force was measured, and the draw."""

    cause: str
    form: str
    kind: str
    force: bool
    seed: int = 0

    @property
    def untold(self) -> bool:
        """True where another right model fits the same records."""
        return self.cause in CAUSES and self.form in CAUSES[self.cause].untold

    def __str__(self) -> str:
        return f"{self.cause}, {self.form}, {self.kind}, {'force' if self.force else 'no force'}"


class End(NamedTuple):
    """The first sentence, all that speaks against the records, its kinds, and how long a processor took, s."""

    first: str
    said: str
    kinds: tuple[str, ...]
    seconds: float


def lines(reduced: bool) -> Iterator[Line]:
    """Cells named, cells that cannot be told and accuse nothing, right tests accused, seconds."""
    wrong = [cell for cell in cells(CAUSES) if not reduced or _is_in_short(cell)]
    tellable, untold = [c for c in wrong if not c.untold], [c for c in wrong if c.untold]
    seeds = range(1 if reduced else 5)
    some = [cell for cell in cells([RIGHT]) if not reduced or (cell.force and cell.kind == SPECTRA)]
    sound = [cell._replace(seed=seed) for cell in some for seed in seeds]
    ends = dict(zip([*wrong, *sound], spread(end_of, [*wrong, *sound]), strict=True))
    missed = [cell for cell in tellable if not re.search(CAUSES[cell.cause].named, ends[cell].first)]
    for cell in missed:
        yield Line(f"not named: {cell}: {ends[cell].first[:200]!r}", "-", "", False)
    yield above(f"cells of {len(tellable)} that can be told: named first", len(tellable) - len(missed), len(tellable))
    fits = [fit_of_other(cell) for cell in untold if cell.kind == SPECTRA]
    yield below("cells that cannot be told: residual of the other right model over the noise", max(fits), EQUALLY)
    for what, group in (("cells that cannot be told", untold), ("right tests", sound)):
        accused = [cell for cell in group if re.search(ANY, ends[cell].said) or MISTAKES & set(ends[cell].kinds)]
        told = "".join(f"; {cell}: {ends[cell].first[:160]!r}" for cell in accused[:4])
        yield below(f"{what}, of {len(group)}: accused of a mistake{told}", len(accused), 0)
    slowest = max(ends, key=lambda cell: ends[cell].seconds)
    yield below(f"seconds of the slowest ({slowest})", ends[slowest].seconds, SECONDS)


def cells(causes: Iterable[str]) -> list[Cell]:
    """All cells of some causes."""
    every = (Cell(*it) for it in product(causes, FORMS, (SPECTRA, RECORDS), (False, True)))
    return [cell for cell in every if cell.cause == RIGHT or _is_possible(cell)]


def _is_possible(cell: Cell) -> bool:
    cause = CAUSES[cell.cause]
    positions = cause.axes != "x" and cell.form == "chain"  # whose sensors move in one base direction each
    return cell.kind in cause.kinds and cause.force in (None, cell.force) and not positions


def _is_in_short(cell: Cell) -> bool:
    """One cell of each cause, the forms in turn, with force where there can be one."""
    at = list(CAUSES).index(cell.cause)
    cause = CAUSES[cell.cause]
    form = FORMS[at % len(FORMS)] if cause.axes == "x" else "full"
    return cell.form == form and cell.kind == cause.kinds[0] and cell.force == (cause.force is not False)


def end_of(cell: Cell) -> End:
    """Statements of the package about a cell."""
    cause = CAUSES.get(cell.cause)
    data = right(cell.kind, force=cell.force, axes=cause.axes if cause else "x", seed=cell.seed)
    begun = time.process_time()
    try:
        result = sysid.identify(problem(cell.form, (cause.made(data) if cause else data).test), rng=0)
        told, kinds = (result.message, *result.undetermined), tuple(one.kind for one in result.contradictions)
        first = result.confidence[0] if result.confidence else ""
    except sysid.SysidError as error:
        told, first, kinds = (str(error),), str(error), ()
    return End(first, " | ".join(told), kinds, time.process_time() - begun)


def fit_of_other(cell: Cell) -> float:
    """Residual of the other right model on the wrong spectra, force included, over that of the truth on right ones."""
    cause = CAUSES[cell.cause]
    data, s = right(cell.kind, force=cell.force, axes=cause.axes), truth(cause.axes)
    return _misfit(cause.made(data).test, cause.untold[cell.form](s)) / _misfit(data.test, s)


def _misfit(test: sysid.Measurement, structure: sysid.Structure) -> float:
    return float(np.hypot(test.residual(structure), test.force_residual(structure) or 0.0))
