"""Model order of whole records: further modes that are worth it, and modes that are none.

The noise of the base shows in all channels at once, along what the structure makes of it. A weak mode whose shape is
another stands out of the errors of a fit, weighed by their full covariance, though in no channel by itself.

A frame that softens with amplitude, under a steady sine, leaves errors at the lines of the sine and of its harmonics
that are far beyond the noise, and a further mode near by explains them. Where what is left is no white noise, such
lines count for less, and the one block of lines where a mode shows most is no evidence for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.least_squares import units_of
from sysid.modal_analysis.modal_fit import STATIC_POLE, Modes
from sysid.modal_analysis.modal_model import Lines
from sysid.modal_analysis.record_fit import (
    ROUGH,
    TRIAL,
    WHOLE,
    Limits,
    RecordFit,
    as_one,
    record_modes,
    refitted,
    without,
)
from sysid.modal_analysis.record_model import Parameters, RecordModel
from sysid.modal_analysis.residual_tests import line_blocks, uneven
from sysid.modal_analysis.response import gains
from sysid.modal_analysis.vector_fitting import DAMPED, RAZOR
from sysid.structure.structure import Array
from sysid.structure.thresholds import ROUND_OFF, beyond_chance

_RATIOS = (0.004, 0.012, 0.036)  # damping ratios that are tried
_REACH = 15.0  # half-power widths about a candidate, of lines that are looked at
_PROMISING = 0.7  # of what a mode must be worth, that a few steps show


def with_further_modes(fit: RecordFit, *, monitor: FitMonitor, some: Measurement | None = None) -> RecordFit:
    """The fit with further modes as long as each is worth more than noise.

    Those of all peaks are tried together, as many as there are modes at most; where they are not worth it, the
    worthiest alone. Where lines are many, `some` is the test at a few of them, as in `refitted`.
    """
    while True:
        beside_all = fit.static and fit.parameters.coupling is None  # poles above the lines came with static modes
        most = 2 * np.pi * fit.test.freq[-1] if beside_all else np.inf
        peaks = peaks_of(fit, least_worth(fit.model), within=(0.0, most))[: fit.model.m]
        more = with_peaks(fit, peaks, some, monitor)
        if more is None and len(peaks) > 1:
            more = with_peaks(fit, peaks[:1], some, monitor)
        if more is None:
            return fit
        fit = more
        monitor.keep(fit)


def with_peaks(fit: RecordFit, peaks: list[Peak], some: Measurement | None, monitor: FitMonitor) -> RecordFit | None:
    """The fit with modes at these peaks, less those that a few steps show to be worth too little; None without any."""
    least, m, p = least_worth(fit.model), fit.model.m, fit.parameters
    for peak in peaks:
        p = with_peak(fit, p, peak)
    monitor.doing = f"{m} modes and {len(peaks)} more"
    while p.modes.omega.size > m:
        more = refitted(fit, p, limits=ROUGH, some=some, monitor=monitor)
        poor = no_modes(more)
        if p.modes.omega.size > m + 1:
            poor |= worth(more) < _PROMISING * least
        poor[: m - fit.static] = poor[poor.size - fit.static :] = False
        if not np.any(poor):
            break
        p = without(more, poor)
    added = p.modes.omega.size - m
    if added == 0 or more.likelihood - fit.likelihood < _PROMISING * added * least or np.any(no_modes(more)):
        return None
    more = refitted(more, more.parameters, limits=TRIAL, some=some, monitor=monitor)
    above = more.model.of_others(more.parameters)[m - fit.static :]
    if np.any(above) and not more.settled and more.likelihood - fit.likelihood >= added * least:  # along a flat valley
        more = refitted(more, more.parameters, limits=TRIAL._replace(rounds=24), some=some, monitor=monitor)
    while more.settled and more.likelihood - fit.likelihood >= max(added, 1) * least and not np.any(no_modes(more)):
        each = worth(more)
        if np.min(each) >= least:
            return more
        # What one of two close together is worth shows without it only, when the other has moved.
        poorest = np.arange(each.size) == np.argmin(each)
        fewer = refitted(more, without(more, poorest), limits=TRIAL, some=some, monitor=monitor)
        if more.likelihood - fewer.likelihood >= least:
            return more
        if added == 0:
            break
        more, added = fewer, added - 1
    return None


def with_so_many_modes(fit: RecordFit, count: int, ours: NDArray[np.bool_]) -> RecordFit:
    """The fit, of which modes within the lines are kept that are `ours` (m,), and so many of these at most.

    Those whose loss the records would feel least go. They stay in the fit: noise of the base as large as missing modes
    would explain the records, with modes that are far from any.
    """
    omega, rise = fit.parameters.modes.omega, joint_worth(fit)
    first, last = 2 * np.pi * fit.test.freq[[0, -1]]
    gone = (omega >= first) & (omega <= last) & ~ours
    while np.count_nonzero(ours & ~gone) > count:
        gone = min((gone | (np.arange(omega.size) == k) for k in np.flatnonzero(ours & ~gone)), key=rise)
    return replace(fit, kept=~gone) if np.any(gone) else fit


def no_modes(fit: RecordFit, *, first: bool = False) -> NDArray[np.bool_]:
    """True for modes that no structure has, whatever they explain, (m,): too damped, or far narrower than a line.

    And for those that drift makes: of less than two periods a record, or of four below the lines. Those above the lines
    may be so narrow among `first` ones: they stand for others, and what takes their place comes later.
    """
    modes, line = fit.parameters.modes, 2 * np.pi * np.min(fit.model.whole.spacing)
    below = modes.omega < 2 * np.pi * fit.test.freq[0]
    slow = (modes.omega < np.where(below, 4, 2) * line) & (not fit.model.whole.grows)
    narrow = (modes.ratios * modes.omega < RAZOR * line) & ~(first & (modes.omega > 2 * np.pi * fit.test.freq[-1]))
    return np.asarray((modes.ratios >= DAMPED) | narrow | slow)


def least_worth(model: RecordModel) -> float:
    """Least fall of ``e' S^-1 e`` by a mode: more than noise makes of a residue of rank one and a pole, anywhere."""
    inputs = model.d + 2 * len(model.moving)
    couplings = 2 * len(model.coupled) // max(model.m, 1)  # of one mode with the others
    return beyond_chance(model.channels + inputs + 1 + couplings, len(_RATIOS) * model.numbers) / 2


def worth(fit: RecordFit, normal: Array | None = None) -> Array:
    """Rise of ``e' S^-1 e``, about, without each mode, (m,): all else moves as far as it is free.

    With `normal` in place of the fit's ``Re J' S^-1 J``, as of lines that count for less.
    """
    rise = joint_worth(fit, normal)
    value = np.array([rise(one) for one in np.eye(fit.model.m, dtype=bool)])
    value[fit.model.m - fit.static :] = np.inf  # they stand for all modes above the lines
    return value


def joint_worth(fit: RecordFit, normal: Array | None = None) -> Callable[[NDArray[np.bool_]], float]:
    """Function of some of the modes, (m,): the same without all of these together."""
    model, N = fit.model, fit.normal if normal is None else normal
    unit, m, n, index = units_of(N), model.m, model.n, model.index
    inverse = np.linalg.inv(N * np.outer(unit, unit) + 1e-10 * np.eye(model.size))
    shapes = np.arange(index.phi.stop).reshape(n, m)
    # With its shape at zero neither participation, pole nor transient of a mode show.
    others = np.hstack([
        index.gamma.start + np.arange(m * model.d).reshape(m, -1), np.arange(m)[:, None] + index.log_omega.start,
        np.arange(m)[:, None] + index.log_ratios.start, model.kept + np.arange(model.n_ends).reshape(m, -1),
    ])  # fmt: skip
    x = np.divide(model.pack(fit.parameters), unit, out=np.zeros(model.size), where=unit > 0)

    def rise(modes: NDArray[np.bool_]) -> float:
        couplings = np.flatnonzero(np.any(modes[model.coupled], axis=1))  # a mode that is gone moves no other
        of_shapes = shapes[:, modes].ravel()
        lost = np.concatenate([of_shapes, model.coupling.start + couplings])
        gone = np.concatenate([lost, others[modes].ravel()])
        # The inverse of this block is the normal matrix of these less what all others explain of it.
        left = np.linalg.inv(inverse[np.ix_(gone, gone)])[: lost.size, : lost.size]
        return float(x[lost] @ left @ x[lost])

    return rise


class Peak(NamedTuple):
    """A further mode: its pole, rad/s, its shape at all channels (c,), and its load by all inputs."""

    omega: float
    ratio: float
    shape: Array
    load: Array


class Trials(NamedTuple):
    """Trial poles, and what the errors of a fit hold of a mode of rank one at each.

    Attributes
    ----------
    omega, ratios : (K,)
    gradient : (K, c, inputs)
        Of ``e' S^-1 e`` / 2 by the residue.
    weights : (K, c, c)
        Mean inverse covariance of the errors about the pole.
    power : (K, inputs, inputs)
        Of the motion that each input makes. The normal matrix of residues is nearly its product with the weights.
    """

    omega: Array
    ratios: Array
    gradient: Array
    weights: Array
    power: Array

    def likeliest(self) -> tuple[Array, Array, Array]:
        """Fall of ``e' S^-1 e`` by the likeliest residue of rank one, (K,), its shape (K, c) and load (K, inputs)."""
        of_channels, of_inputs = (_unit(np.diagonal(m, axis1=1, axis2=2)) for m in (self.weights, self.power))
        gradient = self.gradient * of_channels[:, :, None] * of_inputs[:, None]
        shapes = np.linalg.solve(self.weights * _outer(of_channels), gradient)
        lam, V = np.linalg.eigh(self.power * _outer(of_inputs))
        root = V * _unit(np.where(lam > ROUND_OFF * lam[:, -1:], lam, 0.0))[:, None]
        worth, turn = np.linalg.eigh(root.swapaxes(1, 2) @ gradient.swapaxes(1, 2) @ shapes @ root)
        load = np.einsum("kij,kj->ki", root, turn[:, :, -1])
        return worth[:, -1], of_channels * np.einsum("kci,ki->kc", shapes, load), of_inputs * load


def _unit(squares: Array) -> Array:
    """One over the roots; zero for zeros."""
    return np.divide(1.0, np.sqrt(squares), out=np.zeros_like(squares), where=squares > 0)


def _outer(rows: Array) -> Array:
    """Products of the entries of each row with one another."""
    return rows[:, :, None] * rows[:, None]


def trials_of(fit: RecordFit, at_once: int = 16) -> Trials:
    """Trial poles at all frequencies of the lines, in steps of half a half-power width, of three damping ratios.

    So many at once: neighbours have nearly the same lines. Beside static modes, up to these.
    """
    ends = 2 * np.pi * fit.test.freq[[0, -1]] * [1.0, STATIC_POLE[0] if fit.static else 1.0]
    trials = [np.geomspace(ends[0], ends[1], int(np.log(ends[1] / ends[0]) / ratio) + 2) for ratio in _RATIOS]
    omega, ratios = np.concatenate(trials), np.repeat(_RATIOS, [one.size for one in trials])
    model, K = fit.model, omega.size
    c, inputs = model.channels, model.d + 2 * len(model.moving)
    out = Trials(omega, ratios, np.zeros((K, c, inputs)), np.zeros((K, c, c)), np.zeros((K, inputs, inputs)))
    strength = np.zeros(K)
    cuts = np.concatenate([[0], np.cumsum([one.size for one in trials])])
    blocks = [slice(i, min(i + at_once, b)) for a, b in pairwise(cuts) for i in range(a, b, at_once)]
    for chunk in model.chunks(fit.parameters):
        _add(out, strength, blocks, chunk, fit.levels)
    used = strength > 0
    out.weights[used] /= strength[used, None, None]
    return Trials(*(part[used] for part in out))


def _add(trials: Trials, strength: Array, blocks: list[slice], chunk: Lines, levels: Array) -> None:
    """Add some lines to the sums of all trials whose poles are near."""
    w, weighed, V = chunk.run.w, chunk.weighed(levels), chunk.covered(levels)
    inputs, square = chunk.inputs(weighed.base), chunk.deviations(levels)[0] ** 2
    moved = np.any(inputs, axis=1)
    u = inputs[moved]
    errors = (weighed.whitened_residual[:, None] * u.conj()).reshape(-1, w.size)
    by_line = np.stack([errors.real.T, errors.imag.T], axis=1)  # (L, 2, ...): those of some lines stand together
    hidden = np.concatenate([V.real, V.imag]).transpose(2, 1, 0)
    covered = (hidden @ hidden.swapaxes(1, 2)).reshape(w.size, -1)
    pairs = (u[:, None] * u.conj()).real.reshape(-1, w.size)
    for block in blocks:
        omega, ratios = trials.omega[block], trials.ratios[block]
        reach = 2 * _REACH * ratios[:, None] * omega[:, None]
        first, last = np.searchsorted(w, [(omega - reach[:, 0]).min(), (omega + reach[:, 0]).max()])
        if first == last:
            continue
        near = slice(int(first), int(last))
        g = gains(w[near] / (2 * np.pi), omega, ratios)
        g *= np.abs(w[near] - omega[:, None]) <= reach
        power = g.real**2 + g.imag**2
        trials.gradient[block][:, :, moved] += (g.view(float) @ by_line[near].reshape(2 * g.shape[1], -1)).reshape(
            omega.size, -1, len(u)
        )
        trials.power[block][np.ix_(np.arange(omega.size), moved, moved)] += (power @ pairs[:, near].T).reshape(
            omega.size, len(u), len(u)
        )
        # So many lines in a half-power width tell the mean covariance.
        step = max(1, int(np.count_nonzero(g[0])) // int(2 * _REACH * 16))
        thin = step * power[:, ::step]
        of_base = (thin @ covered[near][::step]).reshape(-1, len(square), len(square))
        total = thin.sum(axis=1)
        every = np.broadcast_to(square, (len(square), w.size))[:, near][:, ::step]
        trials.weights[block] += np.eye(len(square)) * (thin @ every.T)[:, None] - of_base
        strength[block] += total


def peaks_of(
    fit: RecordFit, least: float, widths: float = 5.0, within: tuple[float, float] = (0.0, np.inf)
) -> list[Peak]:
    """Modes that the errors of a fit hold, worth more than `least`, the worthiest first.

    They are so many half-power widths apart, and between two frequencies, rad/s.
    """
    trials = trials_of(fit)
    worth, shapes, loads = trials.likeliest()
    worth[(trials.omega < within[0]) | (trials.omega > within[1])] = 0.0
    found: list[int] = []
    for at in np.argsort(-worth):
        if worth[at] <= least:
            break
        apart = np.abs(np.log(trials.omega[at] / trials.omega[found]))
        if np.all(apart > 2 * widths * np.maximum(trials.ratios[at], trials.ratios[found])):
            found.append(int(at))
    return [Peak(trials.omega[at], trials.ratios[at], shapes[at], loads[at]) for at in found]


def with_peak(fit: RecordFit, p: Parameters, peak: Peak) -> Parameters:
    """Parameters with one more mode, before those that are static."""
    model, (omega, ratio, shape, push) = fit.model, peak
    n, d = model.n, model.d
    phi, gamma = shape[:n], push[:d]
    if model.force and np.linalg.norm(gamma) > 0:
        # The force weighs the mode: what it answers by is the participation times the same.
        weighed = float(shape[n:] @ gamma / (gamma @ gamma))
        scale = np.sqrt(max(weighed, 1e-3 * float(np.linalg.norm(shape[n:]) / np.linalg.norm(gamma)), 1e-300))
        phi, gamma, push = phi / scale, gamma * scale, push * scale
    modes = p.modes
    more = modes.joined(Modes(phi[:, None], gamma[None], np.atleast_1d(omega), np.atleast_1d(ratio)))
    m = modes.omega.size
    return p.with_modes(more, np.vstack([p.ends, push[d:]])).at(np.insert(np.arange(m), m - fit.static, m))


_MORE = 4.0  # times what a mode must be worth where noise alone is left


def without_spurious_modes(
    fit: RecordFit, *, some: Measurement | None = None, monitor: FitMonitor | None = None
) -> RecordFit:
    """The fit without spurious modes, one after the other; as it is where what is left is white noise.

    Where lines are many, `some` is the test at a few of them, as in `refitted`.
    """
    first, test = fit, fit.test
    if fit.static:  # new residues would be without them
        return fit
    stay = np.arange(fit.model.m)
    while np.any(least := _spurious(fit)):
        # From new residues, a few steps: two modes close together may have cancelled each other.
        modes, stay = without(fit, least).modes, stay[~least]
        fit = record_modes(some or test, modes.omega, modes.ratios, monitor=monitor)
    if fit is first:
        return fit
    every = refitted(replace(fit, test=test), fit.parameters, some=some, monitor=monitor)
    other = refitted(first, first.parameters.at(stay), some=some, monitor=monitor)
    fit = max(every, other, key=lambda one: one.schwarz)
    return without_spurious_modes(fit, some=some, monitor=monitor)


def _spurious(fit: RecordFit) -> NDArray[np.bool_]:
    """The mode that is worth least beyond what the model misses, if too little, (m,)."""
    m = fit.parameters.modes.omega.size
    if m == 1 or not uneven(fit):
        return np.zeros(m, bool)
    value = worth_beyond_misfit(fit)
    return (np.arange(m) == np.argmin(value)) & (value < _MORE * least_worth(fit.model))


def worth_beyond_misfit(fit: RecordFit) -> Array:
    """`worth` of each mode, (m,), in lines that count for less where the model misses more, but for one block of them.

    At a line the model misses what is left in its block, and the share of the modes' motion there that it misses of all
    lines together.
    """
    model, p, c = fit.model, fit.parameters, fit.model.channels
    powers: list[list[Array]] = [[] for _ in model.runs]  # of what is left, of all modes, and of each, (2 + m, L)
    for chunk in model.chunks(p):
        each = (chunk.shapes[:, :, None] * chunk.motion).swapaxes(0, 1)  # (m, c, L)
        moved_by = [None, each.sum(axis=0), *each]
        powers[chunk.run.piece].append(np.stack([chunk.weighed(fit.levels, one).power for one in moved_by]))
    whole = [np.concatenate(one, axis=1) for one in powers]
    left, moved, parts = [one[0] for one in whole], [one[1] for one in whole], [one[2:] for one in whole]
    share = sum(map(np.sum, left)) / sum(map(np.sum, moved))
    blocks = [line_blocks(run, fit, 0.0) for run in model.runs]
    weights = [
        1 / (_by_block(lines, power, c) + share * motion / c)
        for lines, power, motion in zip(blocks, left, moved, strict=True)
    ]
    value = worth(fit, model.weighed_by(weights).normal_equations(p, fit.levels).normal)
    sums = np.hstack(
        [
            [[np.sum((weight * mode)[part]) for part in lines] for mode in modes]
            for lines, weight, modes in zip(blocks, weights, parts, strict=True)
        ]
    )  # (m, blocks)
    return np.asarray(value * (1 - sums.max(axis=1) / sums.sum(axis=1)))


def _by_block(blocks: list[NDArray[np.intp]], power: Array, channels: int) -> Array:
    """Misfit about a line in its block, in units of the noise, one at least, (L,)."""
    return np.concatenate([np.full(lines.size, max(1.0, power[lines].mean() / channels)) for lines in blocks])


def pruned(
    fit: RecordFit, monitor: FitMonitor | None, *, limits: Limits = WHOLE, many: float = 100.0, first: bool = False
) -> RecordFit:  # fmt: skip
    """The fit without modes that noise explains, several together where noise explains them all; `first` ones or all.

    Where likelihood falls by `many` times what noise explains, a mode within the width of another one had cancelled
    much of it: then the two begin as one, too.
    """
    while np.any(least := least_of(fit, first=first)):
        fewer = refitted(fit, without(fit, least), limits=limits, monitor=monitor)
        fell = fit.likelihood - fewer.likelihood > many * least_worth(fit.model)
        if fell and (start := _with_one_as_another(fit, least)):
            fewer = max(fewer, refitted(fit, start, limits=limits, monitor=monitor), key=lambda one: one.likelihood)
        fit = fewer
    return fit


def _with_one_as_another(fit: RecordFit, gone: NDArray[np.bool_]) -> Parameters | None:
    """The parameters without some modes, (m,), the first of them as one with the nearest that stays, within widths."""
    modes, first, numbers = fit.parameters.modes, int(np.argmax(gone)), np.arange(gone.size)
    apart = np.abs(np.log(modes.omega / modes.omega[first])) / (modes.ratios + modes.ratios[first])
    nearest = int(np.argmin(np.where(gone | (numbers >= gone.size - fit.static), np.inf, apart)))
    both = np.isin(numbers, (first, nearest))
    return as_one(fit, both, nearest).at(~gone[~both | (numbers == nearest)]) if apart[nearest] < 1 else None


def without_weak_modes(fit: RecordFit, monitor: FitMonitor, near: float = 2.0, few: float = 100.0) -> RecordFit:
    """The fit without modes that noise explains once all else has settled.

    What one of two close together is worth shows without it only, when the other has moved.
    """
    while True:
        fit = pruned(fit, monitor)
        modes, value, least = fit.parameters.modes, worth(fit), least_worth(fit.model)
        value[_of_others(fit)] = np.inf
        apart = np.abs(np.log(modes.omega / modes.omega[:, None])) / (2 * modes.ratios)
        value[np.sort(apart, axis=0)[1:2].min(axis=0, initial=np.inf) > near] = np.inf
        if np.min(value) >= few * least:
            return fit
        weakest = np.arange(value.size) == np.argmin(value)
        fewer = refitted(fit, without(fit, weakest), limits=TRIAL, monitor=monitor)
        if not fewer.settled and fit.likelihood - fewer.likelihood < least:  # else it would creep on for nothing
            fewer = refitted(fewer, fewer.parameters, monitor=monitor)
        if not fewer.settled or fit.likelihood - fewer.likelihood >= least:
            return fit
        fit = fewer


def _of_others(fit: RecordFit) -> NDArray[np.bool_]:
    """True for static modes, and beside them for all above the lines: they stand for others, and need not show."""
    return fit.model.of_others(fit.parameters) | (np.arange(fit.model.m) >= fit.model.m - fit.static)


def least_of(fit: RecordFit, *, first: bool = False) -> NDArray[np.bool_]:
    """Modes that noise explains, all together: the one that explains least and those next to it, (m,); never all."""
    rise, least, m = joint_worth(fit), least_worth(fit.model), fit.model.m
    value = np.array([rise(one) for one in np.eye(m, dtype=bool)])
    value[no_modes(fit, first=first)] = 0.0
    value[_of_others(fit)] = np.inf
    count = int(np.count_nonzero(np.isfinite(value)))  # of which one is left
    lowest, *others = np.argsort(value, kind="stable")
    gone = (np.arange(m) == lowest) & (value < least) & (count > 1)
    for k in others[: max(count - 2, 0)]:
        more = gone | (np.arange(m) == k)
        if value[k] >= least or rise(more) >= least:
            break
        gone = more
    return gone
