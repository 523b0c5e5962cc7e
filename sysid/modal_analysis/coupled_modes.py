"""Modes that dampers couple, as a dashpot between two floors does: where the records ask for the couplings, and values.

The off-diagonal entries Z of ``Phi' C Phi`` make mode shapes complex: to first order that of mode k is
``phi_k + sum_j i w_k Z_jk phi_j / (w_k² - w_j²)``, so that residues have a part in quadrature, which further modes
beside each peak would mimic. The model holds Z itself, exact for any size of it and for close modes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.least_squares import half_inverse, score, unit_diagonal
from sysid.modal_analysis.modal_estimate import Coupling
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.modal_model import NormalEquations, Parameters, SpectralModel
from sysid.modal_analysis.model_order import least_worth, worth
from sysid.modal_analysis.record_fit import ROUGH, TRIAL, RecordFit, refitted, without
from sysid.modal_analysis.record_model import RecordModel
from sysid.modal_analysis.static_modes import at_static_pole, in_gauge, misses_modes_above, with_static_modes
from sysid.structure.simulation import ModalModel
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF, beyond_chance


def score_of_couplings(model: RecordModel, equations: NormalEquations, p: Parameters) -> tuple[float, int]:
    """Fall of twice the sum of squares that couplings promise in one step, and how many show.

    Beside those of modes above the lines with each other, which mimic what is missing of these.
    """
    inside = p.modes.omega <= 2 * np.pi * model.test.freq[-1]
    own = np.zeros(model.size, bool)
    own[model.coupling] = np.any(inside[model.coupled], axis=1)
    return score(equations, own)


def passive(p: Parameters, last: float = np.inf) -> bool:
    """True where the damping takes energy out of every motion: ``Phi' C Phi`` is positive semidefinite.

    It is that of modes up to the last line, rad/s: losses of those above are hardly seen, and all have to be stable.
    Where no force weighed the modes their scales are open, and this asks for more than has to be: late channels would
    pass for couplings that need not be symmetric.
    """
    assert p.coupling is not None
    loss, omega = np.diag(2 * p.modes.ratios * p.modes.omega) + (p.coupling + p.coupling.T) / 2, p.modes.omega
    inside = np.ix_(omega <= last, omega <= last)
    poles = np.linalg.eigvals(ModalModel(omega, loss, p.modes.gamma).state_matrix)
    return bool(np.linalg.eigvalsh(loss[inside]).min(initial=np.inf) >= 0 and poles.real.max() <= 0)


def in_the_lines_alone(model: SpectralModel, p: Parameters, levels: Array, beyond: float) -> Parameters | None:
    """Parameters without couplings of modes within the lines with those beyond; None where these matter.

    Plain spectra have no place for them. `beyond` is the variance of a real number, in units of the levels.
    """
    assert p.coupling is not None
    first, last = 2 * np.pi * model.test.freq[model.test.freq > 0][[0, -1]]
    inside = (p.modes.omega >= first) & (p.modes.omega <= last)
    across = (inside[:, None] != inside) & (p.coupling != 0)
    plain = replace(p, coupling=np.where(across, 0.0, p.coupling))
    rise = 2 * (model.trial_chi2(plain, levels) - model.trial_chi2(p, levels))
    return plain if rise <= beyond * beyond_chance(np.count_nonzero(across) / 2) else None


def with_couplings(
    fit: RecordFit, pruned: Callable[[RecordFit], RecordFit], *, monitor: FitMonitor, some: Measurement | None = None
) -> RecordFit:
    """The fit with couplings of its modes, where the records ask for them beyond chance; `some` as in `refitted`.

    Modes that stood for couplings leave nothing else to determine: `pruned` takes them out of a rough fit.
    """
    p, m = fit.parameters, fit.model.m
    if p.coupling is not None or m - fit.static < 2:
        return fit
    model, equations, (promised, count) = _asked(fit)
    beyond = max(fit.reduced, 1.0)
    above = (np.arange(model.size) >= model.n_fit + model.n * model.d) & (np.arange(model.size) < model.delays)
    if promised <= beyond * beyond_chance(count):
        return fit
    # What modes above the lines leave would pass for couplings of those that stand for them.
    hidden = promised < score(equations, above)[0]
    if hidden and (fit.static or not model.force):
        return fit
    plain = with_static_modes(fit, monitor=monitor) if hidden else fit
    if plain is not fit:
        promised, count = _asked(plain)[2]
        if promised < max(plain.reduced, 1.0) * beyond_chance(count):
            return plain
    monitor.doing = f"{m} modes and the dampers between them"
    more = fit if hidden else _coupled(fit, p, fit.static, pruned, some, monitor)
    above_them = not fit.static and model.force and (hidden or misses_modes_above(more))
    if above_them:  # which dampers couple with those in the lines
        static = refitted(fit, at_static_pole(fit), some=some, limits=ROUGH, monitor=monitor, static=model.d)
        other = _coupled(fit, static.parameters, model.d, pruned, some, monitor)
        more = max(more, other, key=lambda one: (_takes_energy_out(one), one.schwarz))
    if not more.settled:
        more = refitted(more, more.parameters, some=some, monitor=monitor)
    gained = 2 * (more.likelihood - plain.likelihood)
    least = np.sign(max(count := more.model.unknowns - plain.model.unknowns, 0)) * beyond_chance(abs(count))
    single = more.parameters.coupling is None  # where one mode is left
    if single or not (more.settled and _takes_energy_out(more) and gained > beyond * least):
        return with_static_modes(fit, monitor=monitor) if above_them and not hidden else plain
    alone = in_the_lines_alone(more.model, more.parameters, more.levels, beyond)
    if alone is None:
        return in_gauge(more) if model.force else fit  # which weighs the modes, so that couplings are symmetric
    return replace(more, parameters=alone)


def _asked(fit: RecordFit) -> tuple[RecordModel, NormalEquations, tuple[float, int]]:
    """The model with couplings, its equations at a fit without them, and their score.

    Beside what a wrong gain or modes above the lines make, which couplings would mimic.
    """
    p = fit.parameters
    model = RecordModel(fit.test, fit.model.m, gains=True, static=fit.static, coupled=True).at_signal(p)
    equations = model.normal_equations(p, fit.levels)
    return model, equations, score_of_couplings(model, equations, p)


def _coupled(
    fit: RecordFit, p: Parameters, static: int, pruned: Callable[[RecordFit], RecordFit],
    some: Measurement | None, monitor: FitMonitor,
) -> RecordFit:  # fmt: skip
    """The fit with couplings, from parameters without them; modes that stood for couplings are left out."""
    modes = _as_large(p.modes, p.modes.omega.size - static) if fit.model.force else p.modes
    first = replace(p, modes=modes, coupling=np.zeros((p.modes.omega.size,) * 2))
    rough = pruned(refitted(fit, first, some=some, limits=ROUGH, monitor=monitor, static=static))
    more = refitted(rough, rough.parameters, some=some, limits=TRIAL, monitor=monitor)
    while more.model.m - static > 2:  # one may be worth much beside couplings, until the others have moved
        poorest = np.arange(more.model.m) == np.argmin(worth(more))
        fewer = refitted(more, without(more, poorest), some=some, limits=TRIAL, monitor=monitor)
        needed = more.likelihood - fewer.likelihood > least_worth(more.model)
        if not fewer.settled or (needed and (_takes_energy_out(more) or not _takes_energy_out(fewer))):
            break
        more = fewer
    return more


def _as_large(modes: Modes, first: int, many: float = 10.0) -> Modes:
    """The same; of the `first` so many, shapes beyond `many` times that of the mode of most mass are as large as it.

    Without couplings what dampers do to the base force is missed, and may leave a mode next to no mass. Its residues
    are then right, and its shape is without bound, from which no step with couplings leads back.
    """
    size = np.abs(modes.phi[:, :first]).max(axis=0)
    usual = size[np.argmax(np.sum(modes.gamma[:first] ** 2, axis=1))]
    scale = np.ones(modes.omega.size)
    scale[:first] = np.where(size > many * usual, usual / size, 1.0)
    return modes._replace(phi=modes.phi * scale, gamma=modes.gamma / scale[:, None])


def _takes_energy_out(fit: RecordFit) -> bool:
    """True where `passive` is of its couplings, if any: else a mode that is none may stand for what dampers do."""
    return fit.parameters.coupling is None or passive(fit.parameters, 2 * np.pi * fit.test.freq[-1])


def coupling_of(
    model: RecordModel, p: Parameters, normal: Array, order: NDArray[np.intp], at: NDArray[np.intp]
) -> Coupling | None:
    """Couplings at the end of a fit, of modes and unknowns of `Index` in this order; None where they mean nothing.

    `normal` is the normal matrix of all unknowns.
    """
    if p.coupling is None or not model.force:
        return None
    N, size = unit_diagonal(normal)
    kept, own = np.arange(model.kept), np.arange(model.coupling.start, model.coupling.stop)
    others = np.arange(model.kept, model.coupling.start)
    half = half_inverse(N[np.ix_(others, others)], ROUND_OFF)
    turned = half.T @ N[others]
    N = N - turned.T @ turned
    inverse = half_inverse(N[np.ix_(own, own)], ROUND_OFF)
    inverse = inverse @ inverse.T
    follows = np.zeros((own.size, model.index.size))
    follows[:, kept] = -(inverse @ N[np.ix_(own, kept)]) / size[own, None] * size[kept]
    covariance = inverse / 2 / np.outer(size[own], size[own])
    place = np.argsort(order)
    return Coupling(
        p.coupling[np.ix_(order, order)], np.sort(place[model.coupled], axis=1), follows[:, at], covariance
    )  # fmt: skip
