"""First modes of whole records: poles by rough weights, once more by the noise found, and the delays that they show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sysid.errors import InputError
from sysid.measurement.channels import without_constants, without_delays
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.least_squares import half_inverse, unit_diagonal
from sysid.modal_analysis.misfit import deviations
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.model_order import least_of, pruned
from sysid.modal_analysis.record_fit import ROUGH, TRIAL, Limits, RecordFit, on_turned, record_modes, refitted, without
from sysid.modal_analysis.residual_tests import delays_beside_dampers, left_of_clocks, with_shared_clocks
from sysid.modal_analysis.rough_poles import decimated_lines, rough_deviations
from sysid.modal_analysis.vector_fitting import Poles, find_poles
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF

_NEAR = Limits(6, 60, creeping=1.0)


def first_modes(test: Measurement, delays: Array, monitor: FitMonitor) -> tuple[Array, RecordFit | None]:
    """Delays, s, with those that the first modes show, and these modes without them, if any.

    Modes that are still missing may look like small ones, which are left to the fit of all modes; late channels look
    like weak modes beside strong ones, and further modes would stand for what is left of them. What sensors of a wrong
    sign or axis add is taken off: the `constants` of the fit.
    """
    some = without_delays(test.at(decimated_lines(test)), delays)
    try:
        first = near_fit(some, monitor)
        late = _newly_late(first, delays, monitor, 25.0)
        if np.any(late) and not first.settled:  # what is left to settle may look so
            first = settled_modes(first, monitor)
            late = _newly_late(first, delays, monitor, 25.0)
        if not np.any(late):
            first = by_the_noise_found(_without_wrong_sensors(first, monitor), monitor)
            late = _newly_late(first, delays, monitor, 5.0)
    except (InputError, np.linalg.LinAlgError):  # the fit of all modes says why
        return delays, None
    if np.any(late):
        return first_modes(test, delays + late, monitor)
    if not np.any(left := delays_beside_dampers(first) * (delays != 0)):
        return delays, first
    turned = without_constants(without_delays(some, left), first.constants)
    trial = on_turned(first, turned, monitor=monitor)
    better = trial.schwarz - first.schwarz >= 25.0 * price_of_delays(left, np.zeros(left.size), first)
    return (delays + left, trial) if better else (delays, first)


def _without_wrong_sensors(fit: RecordFit, monitor: FitMonitor) -> RecordFit:
    """The fit without shares of the base's motion that sensors of a wrong sign or axis add, where that is likelier.

    Modes, static ones and dampers would stand for them, which take long. Of the sensor that what is left beside the
    modes tells most of, and so on.
    """
    while True:
        (worth, added), G = _motion_beside(fit), fit.test.rigid_body
        sensor, constants = int(np.argmax(worth)), fit.constants.copy()
        moved = _moved_by_mistake(G, sensor, G[sensor] + constants[sensor] + added[sensor])
        if moved is None:
            return fit
        constants[sensor] = moved - G[sensor]
        right = replace(fit, test=without_constants(fit.test, constants - fit.constants))
        trial = refitted(right, fit.parameters, limits=_NEAR, monitor=monitor)
        if trial.schwarz - fit.schwarz < 25.0 * np.count_nonzero(added[sensor]) * np.log(fit.model.numbers) / 2:
            return fit
        # What was found of modes beside the mistake are some of them.
        fit = max(trial, near_fit(trial.test, monitor), key=lambda one: one.schwarz)


def _moved_by_mistake(G: Array, sensor: int, moved: Array, near: float = 0.1) -> Array | None:
    """How the base moves a sensor of wrong sign or axis, (d,), where it does so but for `near` of it; else None.

    Not at all, the other way about, or as much in another direction: what modes below or gains add is left to others.
    """
    size, stated = np.linalg.norm(G, axis=1), G[sensor]
    usual = size[sensor] or size.max()
    as_much = moved * usual / max(float(np.linalg.norm(moved)), ROUND_OFF)
    likely = np.array([0 * stated, -stated, as_much])
    off = np.linalg.norm(likely - moved, axis=1)
    off[2] = max(off[2], abs(stated @ as_much) / usual)
    return likely[np.argmin(off)] if off.min() < near * usual else None


def _motion_beside(fit: RecordFit) -> tuple[Array, Array]:
    """Share of the base's motion in each sensor beside what is fitted, by itself, and its chi-squared.

    (n_sensors,) and (n_sensors, d); what modes above the lines make may be among it.
    """
    (n, d), at = fit.test.rigid_body.shape, fit.model.size
    fitted = np.setdiff1d(np.flatnonzero(~fit.model.held), np.r_[fit.model.of_gains])
    equations = fit.equations.at(np.append(fitted, np.arange(at, at + n * d)))
    normal, size = unit_diagonal(equations.normal)
    gradient, at = equations.gradient / size, fitted.size
    half = half_inverse(normal[:at, :at], ROUND_OFF)
    across = half.T @ normal[:at, at:]
    left, free = gradient[at:] - across.T @ (half.T @ gradient[:at]), normal[at:, at:] - across.T @ across
    worth, added = np.zeros(n), np.zeros((n, d))
    for sensor in range(n):
        its = slice(sensor * d, (sensor + 1) * d)
        along = (half := half_inverse(free[its, its], ROUND_OFF)).T @ left[its]
        worth[sensor], added[sensor] = 2 * along @ along, half @ along
    return worth, added / size[at:].reshape(n, d)


def _newly_late(fit: RecordFit, delays: Array, monitor: FitMonitor, times: float) -> Array:
    """What is left of delays, s, where a fit shows some of channels without any by `times` their price; else zeros."""
    monitor.doing, shadows = "delays", shadows_of(fit.parameters.modes)
    alone = [refitted(fit, without(fit, shadows), monitor=monitor)] if np.any(shadows) else []
    for one in (fit, *alone):
        left = delays_beside_dampers(one)
        if np.any((left != 0) & (delays == 0)):
            trial = on_turned(one, without_delays(fit.test, left), monitor=monitor)
            if np.any(left != (shared := with_shared_clocks(one, left))):
                other = on_turned(one, without_delays(fit.test, shared), monitor=monitor)
                if other.schwarz - trial.schwarz >= 5.0 * np.log(fit.model.numbers) / 2:
                    trial, left = other, shared
            if trial.schwarz - fit.schwarz >= times * price_of_delays(delays + left, delays, fit):
                return left + left_of_clocks(trial)[0]  # a first step may end short
    return np.zeros(delays.size)


def price_of_delays(total: Array, delays: Array, fit: RecordFit) -> float:
    """Schwarz's price of the delays `total` in place of `delays`; equal ones are one number."""
    more = np.unique(total[total != 0]).size - np.unique(delays[delays != 0]).size
    return float(more * np.log(fit.model.numbers) / 2)


def by_the_noise_found(fit: RecordFit, monitor: FitMonitor) -> RecordFit:
    """The fit, or that of poles looked for once more, by its noise, where it is better; settled."""
    monitor.doing, test = "poles by the noise found", fit.test
    again = find_poles(replace(test, response_std=deviations(fit)[0]), monitor=monitor)
    if same_modes(fit.parameters.modes, again):
        return settled_modes(fit, monitor)
    found = _with_poles(test, again, monitor, first=True)
    beside = (found.schwarz > fit.schwarz and fit) or settled_modes(fit, monitor)
    found = settled_modes(found, monitor, beside=beside)
    return settled_modes(max(beside, found, key=lambda one: one.schwarz), monitor)


def rough_fit(test: Measurement, monitor: FitMonitor) -> RecordFit:
    """Modes at the poles that rough weights find, roughly."""
    monitor.doing = "poles by rough weights"
    return _with_poles(test, find_poles(replace(test, response_std=rough_deviations(test)), monitor=monitor), monitor)


def near_fit(test: Measurement, monitor: FitMonitor) -> RecordFit:
    """The same, near enough for the noise: where modes are missing two that are one would move along until the end."""
    fit = rough_fit(test, monitor)
    fit = pruned(refitted(fit, fit.parameters, limits=_NEAR, monitor=monitor), monitor, limits=_NEAR)
    monitor.keep(fit)
    return fit


def _with_poles(test: Measurement, poles: Poles, monitor: FitMonitor, *, first: bool = False) -> RecordFit:
    """One mode at each pole, roughly, without those that noise explains; further ones at a pole show in its errors."""
    monitor.doing = f"{poles.omega.size} modes"
    return pruned(record_modes(test, poles.omega, poles.ratios, monitor=monitor), monitor, limits=ROUGH, first=first)


def settled_modes(fit: RecordFit, monitor: FitMonitor, beside: RecordFit | None = None) -> RecordFit:
    """The fit, settled, without modes that noise explains.

    Where a few steps lead to the modes of the fit `beside` within the lines, and to as many, it is the same: poles
    beyond the lines, which hardly show, move until the end. Some more steps show whether others are likelier.
    """
    if beside is not None:
        if beside.schwarz >= fit.schwarz and leads_to(beside, fit.parameters.modes):
            return beside
        fit = refitted(fit, fit.parameters, limits=TRIAL, monitor=monitor)
        fewer = min(fit.model.unknowns - beside.model.unknowns, 0)  # further modes may go, and add no likelihood
        worse = fit.likelihood - fewer * np.log(fit.model.numbers) / 2 < beside.likelihood
        if worse or (fit.model.m > beside.model.m and leads_to(beside, without(fit, least_of(fit, first=True)).modes)):
            return beside
    fit = pruned(fit if fit.settled else refitted(fit, fit.parameters, monitor=monitor), monitor, first=True)
    monitor.keep(fit)
    return fit


def same_modes(modes: Modes, poles: Poles | Modes) -> bool:
    """True where there are as many, each pole within the half-power width of a mode, and each mode of a pole."""
    if modes.omega.size != poles.omega.size:
        return False
    apart = np.abs(np.log(poles.omega / modes.omega[:, None])) / (2 * modes.ratios[:, None])
    return bool(np.all(apart.min(axis=0, initial=np.inf) < 1) and np.all(apart.min(axis=1, initial=np.inf) < 1))


def leads_to(fit: RecordFit, modes: Modes) -> bool:
    """True where a fit from these modes would end as this settled one: as many, and the same within the lines."""
    last = 2 * np.pi * fit.test.freq[-1]
    inside = (one.at(one.omega <= last) for one in (fit.parameters.modes, modes))
    return fit.settled and fit.model.m == modes.omega.size and same_modes(*inside)


def shadows_of(modes: Modes, weak: float = 0.1) -> NDArray[np.bool_]:
    """Modes within half the half-power width of one that the base drives ten times as much, or by another `weak`, (m,).

    A channel that is late answers as if beside each mode there were such a one.
    """
    f, half_width, size = modes.omega, modes.ratios * modes.omega, np.linalg.norm(modes.gamma, axis=1)
    near = np.abs(f - f[:, None]) < np.minimum(half_width, half_width[:, None])
    return np.any(near & (size[:, None] < weak * size), axis=1)
