"""What of a whole identification is compared with others: figures of its fit, and how far its quantities moved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sysid.assessment.sensitivity import sensitivity
from sysid.nlp import EXACT
from sysid.results.answer import reported_unknowns
from sysid.results.identification import Identification
from sysid.structure.structure import Array, ComplexArray

_LEAST = 0.1  # of a variance, by which that of a part of the records must exceed the whole's
_SAME = 0.1  # relative distance of frequencies up to which a mode is looked for


@dataclass(frozen=True)
class Score:
    """Figures of an identification.

    Attributes
    ----------
    determined : bool
        As in `Identification`.
    parameters : int
        That the records see: the rank of their Jacobian, or the numbers of a modal model where mass and stiffness are
        free.
    numbers : int
        Real numbers of the records that were fitted.
    deviance : float
        -2 log likelihood of normal noise of the stated relative size, its scale in the accelerations and in the force
        of each test as the misfit has it; but for a constant that is the same for all models of the same records. NaN
        of an exact fit, and where the problem states a misfit of its own.
    predicted : float
        Relative residual of what was not fitted: what a change left out, else the problem's validation tests together;
        NaN where there is none.
    frequencies, ratios : tuple of float
        Hz, ascending, and damping ratios.
    unknowns : dict of str to tuple of float
        Those that mean something by themselves, column by column.
    frequency_stds, ratio_stds, unknown_stds
        Their standard deviations; NaN where they are not known, and of an exact fit.

    Notes
    -----
    K. P. Burnham and D. R. Anderson, Model Selection and Multimodel Inference, 2nd ed. (2002), sections 2.2 and 6.4:
    AIC and BIC of least squares. They take lines as independent, and count a difference of 10 as decisive.
    """

    determined: bool
    parameters: int
    numbers: int
    deviance: float
    predicted: float
    frequencies: tuple[float, ...]
    ratios: tuple[float, ...]
    unknowns: dict[str, tuple[float, ...]]
    frequency_stds: tuple[float, ...]
    ratio_stds: tuple[float, ...]
    unknown_stds: dict[str, tuple[float, ...]]

    @classmethod
    def from_tree(cls, tree: dict[str, Any]) -> Score:
        """Give the score of the dictionary that `dataclasses.asdict` made, also where JSON was between."""
        as_tuples: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in tree.items()
        }
        for name in ("unknowns", "unknown_stds"):
            as_tuples[name] = {label: tuple(values) for label, values in tree[name].items()}
        return cls(**as_tuples)

    @property
    def aic(self) -> float:
        """Akaike's information criterion; its differences between models of the same records count."""
        return self.deviance + 2 * self.parameters

    @property
    def bic(self) -> float:
        """The Bayesian (Schwarz's) one."""
        return self.deviance + self.parameters * float(np.log(self.numbers))


@dataclass(frozen=True)
class Move:
    """How far a quantity went.

    Attributes
    ----------
    name : str
    value : float
        Where it went.
    relative : float
        The step, relative to where it was.
    deviations : float
        The same in standard deviations of the step; NaN where these are not known.
    """

    name: str
    value: float
    relative: float
    deviations: float


@dataclass(frozen=True)
class Compared:
    """An identification beside others.

    Attributes
    ----------
    title : str
    success : bool
    residual : float
        Relative, of all fitted tests.
    score : Score
    moves : tuple of Move
        From the one that the others are compared with; empty of itself.
    """

    title: str
    success: bool
    residual: float
    score: Score
    moves: tuple[Move, ...] = ()


def scored(result: Identification, predicted: float | None = None) -> Score:
    """Figures of a result; `predicted` where a change left something out of its problem."""
    s, problem = result.structure, result.problem
    if predicted is None:
        tests = problem.validation
        wrong = [test.relative - test.predict(s) for test in tests]
        predicted = _norm(wrong) / _norm([test.relative for test in tests]) if tests else np.nan
    groups = list(_weighted_misfits(result))
    deviance = np.nan
    if result.residual > EXACT and problem.formulation.fits_records:
        deviance = sum(2 * e.size * float(np.log(np.mean(np.abs(e) ** 2))) for e in groups)
    free = [v.name for v in reported_unknowns(problem) if not v.fixed] if result.x is not None else []
    u = None if result.residual < EXACT else result.quick_uncertainty
    unknown = np.full(s.n, np.nan)
    return Score(
        determined=result.determined,
        parameters=_parameters(result),
        numbers=sum(2 * e.size for e in groups),
        deviance=deviance,
        predicted=predicted,
        frequencies=_plain(s.natural_frequencies),
        ratios=_plain(s.damping_ratios),
        unknowns={name: _plain(result.values[name]) for name in free},
        frequency_stds=_plain(unknown if u is None else u.natural_frequencies),
        ratio_stds=_plain(unknown if u is None else u.damping_ratios),
        unknown_stds={name: _plain(u.variables[name]) for name in free if u is not None and name in u.variables},
    )


def moves(own: Score, other: Score, *, part: bool) -> tuple[Move, ...]:
    """How far frequencies, damping ratios and unknowns went from one result to another, in no order.

    A mode goes to the nearest of the other's, where that one's nearest is this one and lies within 10 %.

    Parameters
    ----------
    own, other : Score
    part : bool
        Whether the other is the same model on a part of the records, so that the variance of a step is the difference
        of both variances (J. A. Hausman, Econometrica 46 (1978) 1251-1271; at least a tenth of the other's, as
        rounding and model errors leave a step where noise leaves none). Else it is the larger of both.
    """
    made: list[Move] = []
    for i, j in _pairs(np.array(own.frequencies), np.array(other.frequencies)):
        frequencies = own.frequencies[i], other.frequencies[j], own.frequency_stds[i], other.frequency_stds[j]
        ratios = own.ratios[i], other.ratios[j], own.ratio_stds[i], other.ratio_stds[j]
        made += [_move(f"mode {i + 1}: frequency, Hz", *frequencies, part=part)]
        made += [_move(f"mode {i + 1}: damping ratio", *ratios, part=part)]
    for name, values in own.unknowns.items():
        ends = other.unknowns.get(name, ())
        if len(ends) == len(values):
            lacking = (np.nan,) * len(values)
            stds = (score.unknown_stds.get(name, lacking) for score in (own, other))
            for k, one in enumerate(zip(values, ends, *stds, strict=True)):
                made.append(_move(name if len(values) == 1 else f"{name} {k + 1}", *one, part=part))
    return tuple(made)


def _move(name: str, here: float, there: float, std: float, other: float, *, part: bool) -> Move:
    variance = max(other**2 - std**2, _LEAST * other**2) if part else max(std**2, other**2)
    step = there - here
    return Move(name, there, step / abs(here) if here else np.nan, step / np.sqrt(variance) if variance > 0 else np.nan)


def _plain(values: ArrayLike) -> tuple[float, ...]:
    return tuple(np.ravel(values, order="F").tolist())


def _pairs(own: Array, other: Array) -> list[tuple[int, int]]:
    if not (own.size and other.size):
        return []
    apart = np.abs(np.log(own[:, None] / other))
    nearest = apart.argmin(axis=1)
    mutual = apart.argmin(axis=0)[nearest] == np.arange(own.size)
    return [(i, int(j)) for i, j in enumerate(nearest) if mutual[i] and apart[i, j] < _SAME]


def _weighted_misfits(result: Identification) -> Iterator[ComplexArray]:
    """Misfits over the stated noise; those of one array share a scale."""
    for test, structure in ((result.measurement, result.structure), *result.further_tests):
        parts = [(test.relative - test.predict(structure), test.response_std)]
        if test.force is not None:
            parts.append((test.force - test.predict_force(structure), test.force_std))
        over = [np.ravel(misfit if std is None else misfit / std) for misfit, std in parts]
        yield from [np.concatenate(over)] if all(std is not None for _, std in parts) else over


def _parameters(result: Identification) -> int:
    problem, s = result.problem, result.structure
    if result.x is not None and not problem.free_modes:
        return sensitivity(problem.formulation, result.x, priors=False).rank
    (n, m), d = s.mode_shapes.shape, s.n_base
    # Frequency, damping ratio, and a shape times a participation; the force weighs each mode, and what no mode carries.
    return m * (n + d + 1) if problem.measurement.force is None else m * (n + d + 2) + d * (d + 1) // 2


def _norm(records: Sequence[ComplexArray]) -> float:
    return float(np.sqrt(sum(np.sum(np.abs(record) ** 2) for record in records)))
