"""Static modes of whole records, at a held pole, for the answer of all modes above the lines; poles beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.least_squares import half_inverse, unit_diagonal
from sysid.modal_analysis.modal_fit import STATIC_POLE, Modes, held_gauge
from sysid.modal_analysis.model_order import peaks_of, with_peak
from sysid.modal_analysis.record_fit import TRIAL, RecordFit, refitted, without
from sysid.modal_analysis.record_model import Parameters
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF, beyond_chance

_LIGHT = 0.1  # share of the spare mass that modes above the lines begin with


def with_static_modes(fit: RecordFit, *, monitor: FitMonitor | None = None) -> RecordFit:
    """The fit with as many modes as base directions at a far pole, held, where it misses what modes above add.

    See `ModeFit.with_static` of spectra.
    """
    test, d = fit.test, fit.test.n_base
    by_laws = fit.model.whole.plain and fit.parameters.laws  # squares: what laws miss is no mode's
    if by_laws or fit.static or fit.stopped or not misses_modes_above(fit):
        return fit
    first, far = at_static_pole(fit), STATIC_POLE[0] * 2 * np.pi * float(test.freq[-1])
    monitor = monitor or FitMonitor()
    monitor.doing = "modes above the lines"
    more = refitted(fit, first, monitor=monitor, static=d)
    passed = lambda one: one.parameters.modes.omega > far * (1 + ROUND_OFF)  # noqa: E731
    if np.any(passed(more)):  # they stand for what the static modes do
        more = refitted(more, without(more, passed(more)), monitor=monitor)
    inside = [np.count_nonzero(one.parameters.modes.omega < 2 * np.pi * test.freq[-1]) for one in (fit, more)]
    whole = more.model.m - d == fit.model.m  # else a pole for many went, and a nearer one may have to take its place
    if not more.settled or np.any(passed(more)) or inside[0] != inside[1] or (whole and not _explains(more, fit)):
        return fit
    more = with_poles_above(more, monitor=monitor)
    return more if _explains(more, fit) else fit


def _explains(more: RecordFit, fit: RecordFit) -> bool:
    """True where a fit of more unknowns gains more than chance."""
    unknowns = max(more.model.unknowns - fit.model.unknowns, 1)
    return 2 * (more.likelihood - fit.likelihood) >= beyond_chance(unknowns)


def misses_modes_above(fit: RecordFit) -> bool:
    """True where what grows as w² in the sensors is left beyond chance."""
    worth, rise = _rise(fit)
    return worth >= beyond_chance(rise.size)


def at_static_pole(fit: RecordFit) -> Parameters:
    """Parameters of a fit with static modes at its end, which begin with what grows as w² in the sensors."""
    p, d, rise = fit.parameters, fit.test.n_base, _rise(fit)[1]
    times, ratio = STATIC_POLE
    far = times * 2 * np.pi * float(fit.test.freq[-1])
    p = without(fit, p.modes.omega >= far)
    if fit.model.force:
        spare = np.diag(p.rigid - p.modes.gamma.T @ p.modes.gamma)
        gamma = np.sqrt(_LIGHT * np.maximum(spare, _LIGHT * np.diag(p.rigid)))
    else:
        gamma = np.sqrt(np.mean(p.modes.gamma**2, axis=0))
    phi, held = times**2 * rise / gamma, np.full(d, far)
    modes = p.modes.joined(Modes(phi, np.diag(gamma), held, np.full(d, ratio)))
    return p.with_modes(modes, np.vstack([p.ends, np.zeros((d, p.ends.shape[1]))]))


def with_poles_above(fit: RecordFit, *, some: Measurement | None = None, monitor: FitMonitor) -> RecordFit:
    """The fit with further poles between the last line and its static modes, by Akaike's criterion: they are no modes.

    See `ModeFit.with_static` of spectra. Where one pole stands for two close modes, what a second one is worth shows
    once both have moved: those that promise seven tenths of their price are tried. Records of many sensors may ask for
    twice as many as spectra have; with fewer, modes in the lines take on what is missing. `some` is as in `refitted`.
    """
    last, far = 2 * np.pi * fit.test.freq[-1] * np.array([1.0, STATIC_POLE[0]])
    near = last, np.sqrt(last * far)  # from further away a pole would go where the static modes are
    monitor.doing = "poles above the lines"
    while True:
        m, modes = fit.model.m, fit.parameters.modes
        price = fit.model_of(fit.parameters.at(np.append(np.arange(m), 0))).unknowns - fit.model.unknowns
        full = np.count_nonzero(modes.omega > last) - fit.static >= 2 * max(fit.test.n_base, 2)
        if not fit.static or full or not (peaks := peaks_of(fit, 0.7 * price, within=near)):
            return in_gauge(fit)
        more = refitted(fit, with_peak(fit, fit.parameters, peaks[0]), limits=TRIAL, some=some, monitor=monitor)
        if not more.settled and more.likelihood - fit.likelihood > price:  # it creeps along a flat valley
            more = refitted(more, more.parameters, limits=TRIAL._replace(rounds=24), some=some, monitor=monitor)
        omega = more.parameters.modes.omega[: -fit.static]
        stays = np.count_nonzero(omega < last) == np.count_nonzero(modes.omega < last)
        if not (more.settled and stays and np.all(omega < far) and more.likelihood - fit.likelihood > price):
            return in_gauge(fit)
        fit = more


def _rise(fit: RecordFit) -> tuple[float, Array]:
    """Chi-squared of what grows as w² in the sensors, which a fit follows; its size where none does, (n, d)."""
    (n, d), equations = fit.test.rigid_body.shape, fit.equations
    at = fit.model.size + n * d  # beside constants too, which wrong gains make
    seen = slice(at + n * d)
    normal, size = unit_diagonal(equations.normal[seen, seen])
    half = half_inverse(normal[:at, :at], ROUND_OFF)
    across, gradient = half.T @ normal[:at, at:], equations.gradient[seen] / size
    left = gradient[at:] - across.T @ (half.T @ gradient[:at])
    free, alone = (half_inverse(one, ROUND_OFF) for one in (normal[at:, at:] - across.T @ across, normal[at:, at:]))
    worth = 2 * float(np.sum((free.T @ left) ** 2)) / max(fit.reduced, 1.0)
    return worth, (alone @ (alone.T @ gradient[at:]) / size[at:]).reshape(n, d)


def in_gauge(fit: RecordFit) -> RecordFit:
    """The same fit, its static modes turned into each other to the form that `held_gauge` keeps."""
    p, d = fit.parameters, fit.static
    if not d:
        return fit
    last = p.modes.at(slice(-d, None))
    gauge = held_gauge(last, np.ones(d), fit.model.force)[0]
    phi = last.phi @ last.gamma @ np.linalg.inv(gauge)
    modes = p.modes._replace(
        phi=np.hstack([p.modes.phi[:, :-d], phi]), gamma=np.vstack([p.modes.gamma[:-d], gauge])
    )  # fmt: skip
    coupling = p.coupling
    if coupling is not None:
        turn = scipy.linalg.block_diag(np.eye(len(coupling) - d), gauge @ np.linalg.inv(last.gamma))
        coupling = turn @ coupling @ turn.T
    return replace(fit, parameters=replace(p, modes=modes, coupling=coupling))


def without_static_modes(fit: RecordFit, *, monitor: FitMonitor) -> RecordFit:
    """The fit without its static modes, for an answer whose modes are all its own."""
    if not fit.static or fit.stopped:
        return fit
    return refitted(fit, without(fit, np.arange(fit.model.m) >= fit.model.m - fit.static), monitor=monitor, static=0)
