"""Score of an identification for comparison with others: figures of its fit, and how far its quantities moved."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.assessment.sensitivity import sensitivity
from sysid.measurement.whole import raised
from sysid.modal_analysis import outliers
from sysid.modal_analysis.pole_functions import unit_columns
from sysid.modal_analysis.response import misfits, states_noise
from sysid.results.identification import Identification
from sysid.results.tables import FREQUENCY, RATIO, label, linear_deviations, quantities
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import EXACT

DECISIVE = 10.0  # difference of AIC or BIC
_LEAST = 0.01  # least variance of a step, as a share of the part's own
_SAME = 0.1  # relative distance of frequencies up to which a mode is looked for
_ALIKE = 0.4  # least MAC of one mode; two that turn in their plane, as a symmetric tower's may, keep half


@dataclass(frozen=True)
class Score:
    """Figures of an identification.

    Attributes
    ----------
    determined : bool
        As in `Answer`.
    parameters : int
        That are fitted and told apart: the rank of the Jacobian, or the numbers of a modal model where mass and
        stiffness are free; one more for the scale of each noise.
    numbers : int
        Real numbers of the records that were fitted.
    deviance : float
        -2 log likelihood of normal noise of the stated deviations, its scale as the misfit has it (where noise is not
        stated: of one size in the accelerations, and in the force, of each test); under Huber's loss of noise with the
        tails that it supposes. But for a constant that is the same for all models of the same records. NaN of an exact
        fit, and where the problem states a misfit of its own.
    predicted : float
        Relative residual of what was not fitted: what a change left out, else the problem's validation tests together;
        NaN where there is none, or where the rest does not tell its motion.
    noise : float
        Variance that `stds` suppose of the accelerations' noise, over the stated one where one is stated.
    modes : int
    values, stds : dict of str to float
        Frequencies in Hz, damping ratios, and unknowns that mean something by themselves, by label; their standard
        deviations, where they are known. None of an exact fit.
    shapes : list of list of float
        Mode shapes at the sensors, (n_sensors, modes).

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
    noise: float
    modes: int
    values: dict[str, float]
    stds: dict[str, float]
    shapes: list[list[float]] = field(default_factory=list)

    @property
    def frequencies(self) -> Array:
        """Of all modes, Hz, ascending, (modes,)."""
        return np.array([self.values[label(i, FREQUENCY)] for i in range(self.modes)])

    @property
    def aic(self) -> float:
        """Akaike's information criterion; its differences between models of the same records count."""
        return self.deviance + 2 * self.parameters

    @property
    def bic(self) -> float:
        """Schwarz's Bayesian information criterion, likewise."""
        return self.deviance + self.parameters * float(np.log(self.numbers))


@dataclass(frozen=True)
class Move:
    """Change of a quantity.

    Attributes
    ----------
    name : str
        With its unit, where it is a frequency.
    value : float
        Where it went.
    relative : float
        The step, relative to where it was; NaN where that is zero.
    deviations : float
        The step in its standard deviations; NaN where these are not known.
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
    message : str
    score : Score
    moves : tuple of Move
        From the one that the others are compared with; empty of itself.
    """

    title: str
    success: bool
    residual: float
    message: str
    score: Score
    moves: tuple[Move, ...] = ()


def scored(result: Identification, predicted: float | None = None) -> Score:
    """Figures of a result; `predicted` where a change left something out of its problem."""
    s, problem = result.structure, result.problem
    if predicted is None:
        tests = result.validation
        wrong = [test.relative - test.predict(s) for test in tests]
        predicted = _norm(wrong) / _norm([test.relative for test in tests]) if tests else np.nan
    noises = list(_weighted_misfits(result))
    exact = result.residual < EXACT
    of_loss = outliers.deviance if problem.loss == "huber" else _normal_deviance
    deviance = np.nan
    if not exact and problem.formulation.fits_records:
        deviance = sum(of_loss(e) + 4 * log_std for e, log_std in noises)
    u = None if exact else result.quick_uncertainty
    stds, noise = dict[str, float](), np.nan
    if u is not None:
        stds = linear_deviations(result, u)
        noise = u.inflation**2 * _noise(result)
    return Score(
        determined=result.determined,
        parameters=_parameters(result) + len(noises),
        numbers=sum(2 * e.size for e, _ in noises),
        deviance=deviance,
        predicted=predicted,
        noise=noise,
        modes=s.natural_frequencies.size,
        values=quantities(result),
        stds=stds,
        shapes=s.mode_shapes.tolist(),
    )


def moves(first: Score, other: Score, *, part: bool) -> tuple[Move, ...]:
    """Changes of frequencies, damping ratios and unknowns from one result to another.

    Modes go to those that are nearest together, within 10 % in frequency; where both have as many sensors, to those
    whose shapes are alike (MAC).

    Parameters
    ----------
    first, other : Score
    part : bool
        Whether the other is the same model on a part of the records. A step is then told in the standard deviation that
        it has by noise alone, see `_variance`; else in the larger of both results', for noise of the size that the
        better fit leaves: what a model lacks is in its own deviations too, and would hide its steps.
    """
    of_modes = {label(i, what) for i in range(first.modes) for what in (FREQUENCY, RATIO)}
    pairs = [(name, name) for name in first.values if name not in of_modes]
    for i, j in _nearest(first, other):
        pairs += [(label(i, what), label(j, what)) for what in (FREQUENCY, RATIO)]
    pairs = [(here, there) for here, there in pairs if here in first.values and there in other.values]
    steps = []
    for here, there in pairs:
        was, step = first.values[here], other.values[there] - first.values[here]
        whole, of_other = first.stds.get(here, np.nan) ** 2, other.stds.get(there, np.nan) ** 2
        noise = other.noise / first.noise
        if part:
            variance = _variance(whole, of_other, noise)
        else:
            variance = float(np.maximum(whole * min(noise, 1.0), of_other / max(noise, 1.0)))
        known = float(np.sqrt(variance)) if variance > 0 else np.nan
        steps.append(Move(here, other.values[there], step / abs(was) if was else np.nan, step / known))
    return tuple(steps)


def _variance(whole: float, part: float, noise: float) -> float:
    """Variance of the step from a fit of all records to one of a part of them, by noise alone.

    With w the share of the information that is in the part, the whole is the mean of the part and of what was left
    out, and the step ``(1 - w) (part - left out)``. Where both fits see the same noise its variance is that of the part
    less that of the whole (J. A. Hausman, Econometrica 46 (1978) 1251-1271). Where the noise was not stated, fits weigh
    as if it were one, though a part may have more: `noise` is what the part has over the whole.
    """
    if not part > 0:
        return np.nan
    share = min(whole * noise / part, 1.0)
    return max(whole + part * (1 - 2 * share), _LEAST * part)


def _nearest(first: Score, other: Score) -> list[tuple[int, int]]:
    """Modes of both that are one, by their frequencies and shapes."""
    apart = np.abs(np.log(first.frequencies[:, None] / other.frequencies)) / _SAME
    mac = np.ones(apart.shape)
    if first.shapes and len(first.shapes) == len(other.shapes):
        one, two = (unit_columns(np.array(score.shapes))[0] for score in (first, other))
        mac = (one.T @ two) ** 2
    none = 2.0  # the cost of a pair that is none: above that of any that is one
    cost = np.where((apart < 1) & (mac >= _ALIKE), apart**2 + 1 - mac, none)
    return [
        (int(i), int(j)) for i, j in zip(*scipy.optimize.linear_sum_assignment(cost), strict=True) if cost[i, j] < none
    ]


def _weighted_misfits(result: Identification) -> Iterator[tuple[ComplexArray, float]]:
    """Misfits over the stated deviations, and the sum of the logarithms of these; those of one array share a scale."""
    problem = result.prepared
    fits = problem.fits(result.structure, result.x)  # of the records as they are given
    unfitted = [] if problem.formulation.fits_records else [(problem.modal[0], result.structure)]
    for modal, structure in unfitted + fits:
        test = modal.records
        weighed = [_over(misfit, std, test.own_lines) for misfit, std in misfits(test, structure)]
        if states_noise(test):
            yield np.concatenate([e for e, _ in weighed]), sum(log_std for _, log_std in weighed)
        else:
            yield from weighed


def _normal_deviance(misfit: ComplexArray) -> float:
    """That of normal misfits whose one variance is their own mean square."""
    return 2 * misfit.size * float(np.log(np.mean(np.abs(misfit) ** 2)))


def _noise(result: Identification) -> float:
    """Variance of the accelerations' noise that the uncertainty supposes, over the stated one where one is stated."""
    problem, test = result.prepared, result.measurement
    if not problem.in_squares:
        counted = problem.pseudo_values(result.structure, result.x).measurement.response_std
        assert counted is not None
        return float(np.mean(counted**2) / (1.0 if test.response_std is None else np.mean(test.response_std**2)))
    if test.response_std is not None:
        return 1.0
    return float(
        np.mean(np.abs(outliers.numbers_at_lines(test.relative - test.predict(result.structure), test.own_lines)) ** 2)
    )


def _over(misfit: ComplexArray, std: Array | None, lines: NDArray[np.bool_]) -> tuple[ComplexArray, float]:
    floored = raised(std)
    if floored is None:
        return outliers.numbers_at_lines(misfit, lines), 0.0
    return outliers.numbers_at_lines(misfit / floored, lines), float(np.sum(np.log(floored).transpose(0, 2, 1)[lines]))


def _parameters(result: Identification) -> int:
    problem, s = result.prepared, result.structure
    formulation = problem.formulation
    if result.x is not None and not problem.free_modes:
        beyond = sum(term.matrices.beyond.size for term in formulation.tests)
        return sensitivity(formulation, result.x, priors=False).rank + beyond
    (n, m), d = s.mode_shapes.shape, s.n_base
    ratios = m if formulation.damping.free else min(m, sum(v.size for v in formulation.of_models[2]))
    ratios += m * (m - 1) // 2 * (not s.modal_damping)
    static, weighed = s.residual.static, problem.measurement.force is not None
    others = s.residual.count - static  # residual modes with poles of their own
    ratios += others * (n + d + 1 + weighed) + static * n + weighed * static * (static + 1) // 2
    if not weighed:
        # A frequency, and a shape times a participation.
        return m * (n + d) + ratios
    # The force weighs each mode, and what no mode carries, unless that was stated.
    totals = formulation.mass.totals
    stated = 0 if totals is None else d if totals.values.ndim == 1 else d * (d + 1) // 2
    return m * (n + d + 1) + ratios + d * (d + 1) // 2 - stated


def _norm(records: Sequence[ComplexArray]) -> float:
    return float(np.sqrt(sum(np.sum(np.abs(record) ** 2) for record in records)))
