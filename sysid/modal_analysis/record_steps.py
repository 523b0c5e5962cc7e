"""Steps of a fit to whole records at given levels of noise, by normal equations whose matrix is kept while it holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.least_squares import SumOfSquares, half_inverse, held_along, minimise, unit_diagonal
from sysid.modal_analysis.record_model import NormalEquations, Parameters, RecordModel
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF

_SETTLED = 1e-3  # fall of the sum of squares, in units of the noise, at which the fit stands still


def minimised(
    model: RecordModel,
    p: Parameters,
    levels: Array,
    monitor: FitMonitor,
    counts: tuple[int, int],
    equations: KeptEquations,
    creeping: float,
    many: int = 4,
) -> tuple[Parameters, float, bool]:
    """Levenberg-Marquardt steps at given levels; `counts` of iterations so far, and of steps at most.

    They end where one gains less than `creeping`. Beside static modes others above the lines are no modes of the
    structure, and follow flat valleys: where a step gains less than one, which no criterion would tell from none, the
    end need not be theirs. After `many` such steps all else settles beside them as they are.
    """
    done, most = counts

    def steps(problem: SumOfSquares, ends: Callable[[Parameters, int], bool]) -> tuple[Parameters, float, bool]:
        before, small = np.inf, 0

        def tell(i: int, at: Parameters, chi2: float) -> bool:
            nonlocal before, small
            monitor(done + i, float(np.sqrt(2 * chi2 / model.numbers)))
            gained, before = before - chi2, chi2
            small = (small + 1) * (gained < 1)
            return gained < creeping or (small > 0 and ends(at, small))

        return minimise(problem, tell, most, lambda _: _SETTLED)

    problem = SumOfSquares(
        model.pack(p), model.unpack, lambda trial: model.trial_chi2(trial, levels),
        lambda at: equations(at, levels), lambda at: equations.renewed(at, levels), model.moved,
        (lambda at, x, step: model.bent(at, levels, x, step)) if model.static else None,
    )  # fmt: skip
    static, still = model.static > 0, lambda at: equations.still_in_lines(at, levels)
    p, chi2, ended = steps(problem, lambda at, small: static and (small >= many or still(at)))
    if ended or not static or still(p):
        return p, chi2, ended or static
    held = _above(model, p)
    beside = replace(
        problem, start=model.pack(p), equations=lambda at: equations(at, levels).holding(held),
        renewed=lambda at: (anew := equations.renewed(at, levels)) and anew.holding(held),
    )  # fmt: skip
    return steps(beside, lambda *_: False)


def _above(model: RecordModel, p: Parameters) -> NDArray[np.bool_]:
    """True for unknowns of modes above the lines beside static modes, (p,), and of static ones that dampers move."""
    index, stays = model.index, model.of_others(p)
    stays |= (np.arange(model.m) >= model.m - model.static) & (p.coupling is not None)  # dampers alone move these
    held = np.zeros(model.size, bool)
    held[index.phi] = np.tile(stays, model.n)
    held[index.gamma] = np.repeat(stays, model.d)
    held[index.log_omega] = held[index.log_ratios] = stays
    held[model.kept : model.kept + model.n_ends] = np.repeat(stays, model.n_ends // model.m)
    held[model.coupling] = np.any(stays[model.coupled], axis=1)
    return held


class KeptEquations:
    """Normal equations of one fit; their matrix is kept as long as parameters and levels hardly move.

    Gradients, which decide where the fit ends, are always exact; they take a small part of the matrix's time. The
    logarithm of a damping ratio that is next to `none`, or above the lines beside static modes, counts as known to
    `known` at least: it hardly shows, and a long step of it would be refused with those of all others.
    """

    def __init__(self, model: RecordModel, coarse: RecordModel | None) -> None:
        self.model, self.of_matrix = model, coarse or model
        self.at: tuple[tuple[Parameters, Array], ...] = ()
        self.normal: Array = np.zeros((0, 0))

    def __call__(
        self, p: Parameters, levels: Array, near: float = 0.2, known: float = 3.0, none: float = 1e-6
    ) -> NormalEquations:
        """At these parameters and levels; the matrix of ones so `near`, relative, or from a coarser model."""
        if not self.model.laws and self._off(p, levels) < near:  # of laws a gradient takes as long as the matrix
            return self.model.gradient(p, levels)._replace(normal=self.normal)
        equations = self.of_matrix.normal_equations(p, levels)
        self.at, self.normal = ((p, levels),), held_along(equations.normal, self.model.scales(p))
        hardly = self.model.of_others(p) | (p.modes.ratios < none)
        ratios = np.r_[self.model.index.log_ratios][hardly]
        self.normal[ratios, ratios] = np.maximum(self.normal[ratios, ratios], known**-2)
        if self.of_matrix is not self.model:
            equations = self.model.gradient(p, levels)
        return equations._replace(normal=self.normal)

    def still_in_lines(self, p: Parameters, levels: Array) -> bool:
        """True where a step promises no fall of the sum of squares while modes above the lines stay as they are."""
        here = self(p, levels).at(~_above(self.model, p))
        normal, size = unit_diagonal(here.normal)
        return bool(np.sum((half_inverse(normal, ROUND_OFF).T @ (here.gradient / size)) ** 2) < 10 * _SETTLED)

    def renewed(self, p: Parameters, levels: Array) -> NormalEquations | None:
        """The same with the matrix of these very parameters; None where it was."""
        return None if any(one is p and old is levels for one, old in self.at) else self(p, levels, near=0.0)

    def _off(self, p: Parameters, levels: Array) -> float:
        """How far these are from the parameters and levels of the matrix, relative; infinite without one."""
        ends = 2 * np.pi * self.model.test.freq[[0, -1]]
        return min((_moved(one, p, ends) + _largest(levels / before) for one, before in self.at), default=np.inf)


def _moved(before: Parameters, after: Parameters, ends: Array) -> float:
    """Largest change: of a pole over how far it is from the lines (`ends`, rad/s), a shape, a coupling over losses."""
    modes, other = before.modes, after.modes
    loss = np.sqrt(2 * modes.ratios * modes.omega)
    apart = 0.0 if before.coupling is None else np.asarray(after.coupling) - before.coupling
    coupled = np.abs(apart / np.outer(loss, loss)).max()
    turned = np.abs(other.phi - modes.phi).max(axis=0) / np.abs(modes.phi).max(axis=0)
    away = np.hypot(modes.ratios, 1 - np.clip(modes.omega, *ends) / modes.omega)  # relative; half a width, or more
    pole = np.hypot(np.log(other.omega / modes.omega), modes.ratios * np.log(other.ratios / modes.ratios)) / away
    return float(max(turned.max(), pole.max(), coupled))


def _largest(ratios: Array) -> float:
    """Largest change by a ratio."""
    return float(np.abs(np.log(ratios)).max())
