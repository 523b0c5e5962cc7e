"""Tests of what a fit of whole records leaves: levels of noise, the scatter of the modes, runs in motion, gains.

Noise: what the errors of all channels tell of that of one, over its deviation, is complex white noise of variance one
where model and levels are right. Its power over k lines is then a gamma variable of k, which any band may exceed by
chance: all bands of 8, 16, 32 ... lines, each begun half a band after the other, of all channels and runs are
counted together.

Scatter: model error sits at the peaks. Each block of lines, some half-power widths long, then tells its own error:
what its score would move the modes by, in one linear step from the end of the fit. The fit has taken a part of each
block's errors: of white noise, a block with the share H of the information leaves a score of covariance ``H (I - H)``.
The score over the root of ``I - H`` has H again, so that the squares of all moves make the covariance without bias
(White 1982; MacKinnon and White 1985, HC2, a block in the place of a number). The whole ``I - H``, HC3, is the
jackknife, which is too wide: a block may hold most of what tells a mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.measurement.channels import without_constants
from sysid.modal_analysis.calibration import Calibration
from sysid.modal_analysis.delays import Delays, delays_beyond_chance, least_delay
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.least_squares import half_inverse, over_root_of_rest, score, unit_diagonal
from sysid.modal_analysis.modal_estimate import Excess, Gains, VaryingLevel
from sysid.modal_analysis.noise_levels import NO_NOISE, level_deviations, likeliest_levels
from sysid.modal_analysis.record_fit import RecordFit, refitted
from sysid.modal_analysis.record_model import Parameters, Run
from sysid.structure.structure import Array
from sysid.structure.thresholds import FALSE_ALARM, ROUND_OFF, beyond_chance, most_deviations

_FEWEST = 8  # lines of a band
_UNTOLD = 0.5  # standard deviation of a level's logarithm, beyond which the records do not determine it
_MISSED = 5.0  # times the noise, that what a model misses may be for a delay or a gain
_TAKEN = 0.98  # share of the information, at most, that is taken to be a block's


def excess_of(fit: RecordFit) -> tuple[Excess, ...]:
    """Channels with more than their noise in a band, each its most significant band, the most significant first."""
    powers = noise_powers(fit)
    model, test = fit.model, fit.test
    bands = sum(_count(power.shape[1]) * len(power) for power in powers)
    found: list[tuple[float, Excess]] = []
    levels = np.sqrt(fit.levels_of_runs)
    for number, (lines, power) in enumerate(zip(test.own_lines, powers, strict=True)):
        freq, runs = test.freq[lines], [run for run in model.runs if run.number == number]
        both = np.concatenate([np.vstack([run.outputs, run.base]) for run in runs], axis=1)
        size = np.sqrt(np.mean(np.abs(both) ** 2, axis=1) / runs[0].density)
        for channel in np.flatnonzero(levels[number] > NO_NOISE * size):
            best = most_unlikely(power[channel], bands)
            if best is not None:
                first, last, weight = best
                factor = float(np.sqrt(np.mean(power[channel, first:last])))
                found.append((weight, Excess(
                    int(channel), number, float(freq[first]), float(freq[last - 1]), factor
                )))  # fmt: skip
    return tuple(one for _, one in sorted(found, key=lambda pair: -pair[0]))


def noise_powers(fit: RecordFit) -> list[Array]:
    """Squares of the noise of each channel as all errors tell it, over their variances, (c + d, lines) a run."""
    parts: list[list[Array]] = [[] for _ in range(fit.test.n_runs)]
    for chunk in fit.model.chunks(fit.parameters):
        seen, V = chunk.weighed(fit.levels).whitened_residual, chunk.covered(fit.levels)
        squares = chunk.deviations(fit.levels)[0] ** 2
        of_outputs = squares - np.sum(np.abs(V) ** 2, axis=0)
        H = chunk.H.swapaxes(0, 1)
        base = np.sum(H.conj() * seen, axis=1)
        hidden = sum(np.abs(np.sum(H.conj() * part, axis=1)) ** 2 for part in V)
        of_base = np.sum(squares * np.abs(H) ** 2, axis=1) - hidden
        both, size = np.abs(np.concatenate([seen, base])) ** 2, np.concatenate([of_outputs, of_base])
        parts[chunk.run.number].append(both / np.where(size > 0, size, np.inf))
    return [np.concatenate(part, axis=1) for part in parts]


def _sizes(lines: int) -> Sequence[int]:
    """Lines of bands: powers of two, and all lines."""
    return [*(_FEWEST * 2**i for i in range(64) if _FEWEST * 2**i < lines), lines] if lines >= _FEWEST else []


def _starts(size: int, lines: int) -> NDArray[np.intp]:
    """First lines of bands of one size."""
    return np.arange(0, lines - size + 1, max(size // 2, 1))


def _count(lines: int) -> int:
    """Number of bands."""
    return sum(_starts(size, lines).size for size in _sizes(lines))


def most_unlikely(power: Array, bands: int) -> tuple[int, int, float] | None:
    """The band of lines with the least likely excess, of `bands` that are looked at; None where all may be chance.

    Parameters
    ----------
    power : (lines,)
        Squares, exponential variables of mean one where nothing but noise is there.

    Returns
    -------
    first line, line after the last, logarithm of how unlikely it is about
    """
    total = np.concatenate([[0.0], np.cumsum(power)])
    best: tuple[int, int, float] | None = None
    for size in _sizes(power.size):
        first = _starts(size, power.size)
        held = total[first + size] - total[first]
        ratio = held / size
        weight = size * (ratio - 1 - np.log(np.maximum(ratio, 1e-300)))  # Chernoff's bound
        weight[ratio <= 1] = 0.0
        at = int(np.argmax(weight))
        if (best is None or weight[at] > best[2]) and scipy.special.gammaincc(size, held[at]) < FALSE_ALARM / bands:
            best = int(first[at]), int(first[at] + size), float(weight[at])
    return best


def with_varying_levels(fit: RecordFit, *, monitor: FitMonitor | None = None) -> RecordFit:
    """The fit with levels that vary, for the channels where the noise is not white; as it is where none is.

    Also as it is where smooth levels do not explain what is left, which is the error of a model, at its peaks, or hum:
    the levels are tried beside the modes as they are, and only then fitted with them.
    """
    assert fit.test.whole is not None
    if fit.test.whole.noise is not None or fit.test.whole.grows:
        return fit
    found, trial = excess_of(fit), fit
    varying = np.zeros((fit.test.n_runs, fit.levels.shape[1]), bool)
    while found:
        before = varying.copy()
        varying[[one.run for one in found], [one.channel for one in found]] = True
        if np.array_equal(varying, before):
            return fit
        trial = _levels_alone(fit, varying.copy())
        found = excess_of(trial)
    if trial is fit:
        return fit
    trial = refitted(trial, fit.parameters, monitor=monitor)
    return fit if excess_of(trial) or trial.schwarz < fit.schwarz else trial


def _levels_alone(fit: RecordFit, varying: NDArray[np.bool_]) -> RecordFit:
    """The fit with some levels that vary, and the modes as they are."""
    assert fit.test.whole is not None
    trial = replace(fit, test=replace(fit.test, whole=replace(fit.test.whole, varying=varying)))
    levels = fit.levels_of_runs[[run.number for run in trial.model.runs]]
    return replace(trial, levels=likeliest_levels(trial.model, fit.parameters, levels))


def varying_levels(fit: RecordFit) -> tuple[VaryingLevel, ...]:
    """Channels whose level varies, and between what deviations of a sample."""
    varying = fit.model.whole.varying
    if varying is None:
        return ()
    found = []
    for number, channel in np.argwhere(varying):
        rows = [run.piece for run in fit.model.runs if run.number == number]
        std = np.sqrt(fit.levels[rows, channel])
        found.append(VaryingLevel(int(channel), int(number), float(std.min()), float(std.max())))
    return tuple(found)


def unidentifiable_levels(fit: RecordFit) -> tuple[tuple[int, int], ...]:
    """Run and channel of levels that were found and that the records do not determine; none where there is no noise."""
    assert fit.test.whole is not None
    power = np.sum(np.abs(np.concatenate([fit.test.outputs, fit.test.base], axis=1)) ** 2, axis=2)
    rms = np.sqrt(power / (fit.test.own_lines.sum(axis=1) * fit.test.whole.density)[:, None])
    if fit.test.whole.noise is not None or np.all(np.sqrt(fit.levels_of_runs) <= NO_NOISE * rms):
        return ()
    wide = level_deviations(fit.model, fit.parameters, fit.levels) > _UNTOLD
    return tuple((int(run), int(channel)) for run, channel in np.argwhere(wide))


def line_blocks(run: Run, fit: RecordFit, shift: float, widths: float = 3.0, least: int = 4) -> list[NDArray[np.intp]]:
    """Lines of a run in blocks of so many half-power widths, of some lines at least; the first begins at a `shift`."""
    modes = fit.parameters.modes
    order = np.argsort(modes.omega)
    width = np.interp(run.w, modes.omega[order], 2 * widths * (modes.ratios * modes.omega)[order])
    spacing = np.gradient(run.w)
    at = np.cumsum(spacing / np.maximum(width, least * spacing)) + shift
    cuts = np.flatnonzero(np.diff(np.floor(at))) + 1
    return np.split(np.arange(run.w.size), cuts)


def scatter(fit: RecordFit) -> Array | None:
    """Twice the covariance of the score over the unknowns of `Index`, (p, p); None where what is left is white.

    With A, the information of the fit, the covariance of the modes is ``A^-1 B A^-1 / 2``; for white noise B is A.
    """
    # Levels stated too low or too high are no reason: the power of the misfit counts once, with the information.
    return scatter_over_blocks(fit) if _missed(fit) else None


def scatter_over_blocks(fit: RecordFit, partitions: int = 4) -> Array:
    """The same, whatever is left, over partitions that begin later each: where blocks begin must not matter."""
    model, p = fit.model, fit.parameters
    N, size = unit_diagonal(fit.normal)
    held = model.held | np.isin(np.arange(model.size), np.r_[model.of_gains])  # as in `RecordFit.information`
    N[held], N[:, held] = 0.0, 0.0
    half, size = half_inverse(N, 1e-12), np.where(held, np.inf, size)
    meat = np.zeros((half.shape[1],) * 2)
    columns = [model.chunk(p, run.at(slice(0, 1))).columns() for run in model.runs]
    for shift in np.arange(partitions) / partitions:
        for run, run_columns in zip(model.runs, columns, strict=True):
            at = size[run_columns.unknowns]
            for lines in line_blocks(run, fit, shift):
                products = model.chunk(p, run.at(lines)).products(fit.levels, run_columns)
                root = half[run_columns.unknowns] / at[:, None]
                grown = over_root_of_rest(root, products.normal, root.T @ products.gradient, _TAKEN)
                meat += np.outer(grown, grown) / partitions
    # In moves of all unknowns, of which those of `Index` are kept: A^-1 B A^-1 is that of the moves.
    kept = model.kept
    moved = (half @ meat @ half.T)[:kept, :kept] / np.outer(size[:kept], size[:kept])
    A = fit.information()
    B = np.zeros_like(A)
    B[:kept, :kept] = 2 * A[:kept, :kept] @ moved @ A[:kept, :kept]
    return B


def uneven(fit: RecordFit, mean: float = 1.0, *, but: float = 0.0) -> bool:
    """True where the power of what is left differs between blocks of lines, and from its mean, by more than chance.

    In all blocks together, or rises above it in one. With `but` that share of the blocks, the loudest, is left out, and
    the mean is that of the others.
    """
    model, c = fit.model, fit.model.channels
    blocks = list[tuple[float, float]]()  # power and numbers
    powers: list[list[Array]] = [[] for _ in model.runs]
    for chunk in model.chunks(fit.parameters):
        powers[chunk.run.piece].append(chunk.weighed(fit.levels).power)
    for run, parts in zip(model.runs, powers, strict=True):
        power = np.concatenate(parts)
        blocks += [(float(np.sum(power[lines])), float(c * lines.size)) for lines in line_blocks(run, fit, 0.0)]
    held, numbers = np.array(blocks).T
    if but:
        kept = np.argsort(held / numbers)[: held.size - int(np.ceil(but * held.size))]
        held, numbers = held[kept], numbers[kept]
        mean = held.sum() / numbers.sum()
    off, rare = (held / mean - numbers) / np.sqrt(numbers), scipy.special.gammaincc(numbers, held / mean)
    return bool(np.sum(off**2) > beyond_chance(off.size, 2) or np.min(rare) < FALSE_ALARM / (2 * off.size))


def runs_in_motion(fit: RecordFit) -> tuple[int, ...]:
    """Runs stated to be at rest at both ends whose transients the records show, by a score test (Rao 1948).

    Where the fit with these transients still leaves more than noise about the peaks, the model is wrong and no run is
    accused. Where the fit was stopped none is looked for.
    """
    assert fit.test.whole is not None
    if fit.stopped or fit.test.whole.grows:
        return ()
    stated = [run for run, rest in enumerate(fit.test.whole.at_rest) if rest]
    found = []
    for run in stated:
        moving, p = _moving(fit, (run,))
        chi2, freedom = _score(moving, p)
        if scipy.special.chdtrc(freedom, chi2) < FALSE_ALARM / len(stated):
            found.append(run)
    if not found:
        return ()
    again = refitted(*_moving(fit, tuple(found)))
    return () if uneven(again) else tuple(found)


def _moving(fit: RecordFit, runs: tuple[int, ...]) -> tuple[RecordFit, Parameters]:
    """The fit with some runs in motion, not yet fitted, and its parameters, where their transients are zero."""
    whole, p = fit.test.whole, fit.parameters
    assert whole is not None
    other = replace(whole, at_rest=tuple(rest and run not in runs for run, rest in enumerate(whole.at_rest)))
    ends: Array = np.zeros((len(p.ends), 2 * len(other.moving)))
    for at, run in enumerate(other.moving):
        if run in whole.moving:
            was = 2 * whole.moving.index(run)
            ends[:, 2 * at : 2 * at + 2] = p.ends[:, was : was + 2]
    return replace(fit, test=replace(fit.test, whole=other)), replace(p, ends=ends)


def _score(fit: RecordFit, p: Parameters) -> tuple[float, int]:
    """Chi-squared of all that the unknowns could still explain, and its degrees of freedom beyond those of the fit."""
    model = fit.model_of(p)
    added = np.zeros(model.size, bool)
    ends = np.zeros(p.ends.shape, bool)
    ends[:, np.all(p.ends == 0, axis=0)] = True
    added[model.kept : model.kept + model.n_ends] = ends.ravel()
    return score(model.normal_equations(p, fit.levels), added)


def gain_errors_of(fit: RecordFit) -> Gains:
    """A step of all unknowns from the end of a fit, the gains and what modes above the lines make among them.

    Once with that part and once without it: by how much the two differ counts among the errors of the second, and the
    better known of both is taken. Motion with the base in any of its directions is asked for beside that part.

    Poles above the lines stand for more modes than there are of them: the part that these leave is asked for then, as
    where both agree by chance the first would pass for exact. What the model misses beyond both counts as well.
    """
    asked, G = _asked_of_gains(fit), fit.test.rigid_body
    equations, (n, d) = fit.equations.at(asked), G.shape
    at = asked.size - 3 * n * d  # what is asked for comes behind all that was fitted
    along = scipy.linalg.block_diag(np.eye(at), scipy.linalg.block_diag(*G[:, :, None]), np.eye(2 * n * d))
    normal, size = unit_diagonal(along.T @ equations.normal @ along)
    gradient = along.T @ equations.gradient / size

    def estimate(count: int) -> tuple[Array, Array]:
        half = half_inverse(normal[:count, :count], ROUND_OFF)
        return half @ (half.T @ gradient[:count]) / size[:count], np.linalg.norm(half[at : at + n], axis=1)

    (step, plain_std), (both, std) = estimate(at + n), estimate(size.size)
    plain, error = step[at:], both[at : at + n]
    missed = fit.model.whole.plain or (_missed(fit) and _missed(_with_gains(fit, asked[:at], step)))
    beyond = max(fit.reduced, 1.0) * (_MISSED**2 if missed else 1.0)
    plain_std, std = (np.sqrt(beyond / 2) * one / size[at : at + n] for one in (plain_std, std))
    plain_std = np.hypot(plain_std, plain - error)
    better = (plain_std < std) & np.all(fit.parameters.modes.omega <= 2 * np.pi * fit.test.freq[-1])
    rigid, chi2 = _rigid(fit, beyond)
    taken = np.sum(fit.constants * G, axis=1) / np.maximum(np.sum(G**2, axis=1), ROUND_OFF)
    fitted = half_inverse(normal[:at, :at], ROUND_OFF)
    half = np.zeros((fit.model.size, fitted.shape[1]))
    half[asked[:at]] = fitted / size[:at, None]
    of_constants = half @ (fitted.T @ normal[:at, at : at + n]) * size[at : at + n]
    return Gains(
        np.where(better, plain, error) + taken, np.where(better, plain_std, std), fit.freedom,
        _moves_by_gains(fit, half, of_constants), rigid, chi2,
    )  # fmt: skip


def _missed(fit: RecordFit) -> bool:
    """True where what is left is no white noise: the model misses something, which gains and delays make up for."""
    return uneven(fit, 2 * fit.chi2 / fit.model.numbers)


def _with_gains(fit: RecordFit, asked: NDArray[np.intp], step: Array) -> RecordFit:
    """The fit after a step of its unknowns `asked` and then of all gains, which leaves to a model what it misses."""
    x = np.zeros(fit.model.size)
    x[asked], errors = np.split(step, [asked.size])
    p = fit.model.unpack(fit.model.moved(fit.model.pack(fit.parameters), x))
    trial = replace(fit, test=without_constants(fit.test, errors[:, None] * fit.test.rigid_body), parameters=p)
    return replace(trial, chi2=trial.model.gradient(p, fit.levels).chi2)


def calibration_of(fit: RecordFit, stated: Calibration) -> Calibration:
    """Errors of gains by a step of all unknowns from the end of a fit, beside their tolerances, and what is left.

    What modes above the lines make is asked for too. What the model misses beyond the noise counts as noise of the
    records, beside which tolerances weigh more. Sensors that are wrong beyond both tell nothing of the others.
    """
    model, n, d = fit.model, fit.model.n, fit.model.d
    own, above = np.r_[model.of_gains], np.arange(model.n_fit + n * d, fit.asked.delays)
    others = np.setdiff1d(np.concatenate([np.flatnonzero(~model.held), above]), own)
    equations = fit.equations.at(np.concatenate([others, own]))
    normal, size = unit_diagonal(equations.normal)
    gradient, at = equations.gradient / size, others.size
    half = half_inverse(normal[:at, :at], ROUND_OFF)
    across = half.T @ normal[:at, at:]
    seen = (normal[at:, at:] - across.T @ across) * np.outer(size[at:], size[at:])  # tolerances included
    step = np.linalg.solve(seen, size[at:] * (gradient[at:] - across.T @ (half.T @ gradient[:at])))
    of_records, found = seen - np.eye(own.size) / 2, fit.parameters.gains + step
    weight, told = 2 / max(fit.reduced, 1.0), np.flatnonzero(stated.tolerance)[: own.size]
    of_records, pulled = weight * of_records, weight * (of_records @ found + found / 2)
    held = np.where(np.isin(told, np.flatnonzero(np.any(fit.constants, axis=1))), 0.0, 1.0)
    while True:  # an error is off by its mean over the root of what records take away of its variance, one before them
        covariance = np.linalg.inv(of_records + np.diag(held))
        shown = np.where((told < n) & (held == 1), 1 - np.diag(covariance), 0.0)
        off = np.abs(covariance @ pulled) / np.sqrt(np.where(shown > ROUND_OFF, shown, np.inf))
        if off.max(initial=0.0) < most_deviations(n):
            break
        held[np.argmax(off)] = 0.0
    right, scale = held == 1, stated.tolerance[told]
    values, left = np.zeros(stated.values.size), np.diag(stated.tolerance**2)
    values[told[right]] = (scale * (covariance @ pulled))[right]
    left[np.ix_(told[right], told[right])] = (scale[:, None] * covariance * scale)[np.ix_(right, right)]
    return replace(stated, values=values, covariance=left)


def _asked_of_gains(fit: RecordFit) -> NDArray[np.intp]:
    """Unknowns that are asked where gains are, errors within tolerances held, as what records show does not know of."""
    left_out = np.concatenate([np.r_[fit.model.of_gains], np.flatnonzero(fit.model.held)])
    return np.setdiff1d(np.arange(fit.asked.delays), left_out)


def _moves_by_gains(fit: RecordFit, half: Array, of_constants: Array) -> Array:
    """See `Gains`; ``half half'`` is the inverse of the normal matrix of the fit.

    A sensor that reads too much records `1 + error` times all its motion, transients included: its rows of what is
    linear in it take the factor, and G u beside them moves the fit by `of_constants` (unknowns, n_sensors). Of a base
    that reads too much, all records are that much less of what they are taken to be.
    """
    model, p, (n, d) = fit.model, fit.parameters, fit.test.rigid_body.shape
    pulls = np.zeros((2 * d, model.size))
    columns = {run.piece: model.chunk(p, run.at(slice(0, 1))).columns() for run in model.runs}
    for chunk in model.chunks(p):
        channels, base = chunk.predicted(chunk.run.base, chunk.motion), chunk.run.base
        at = columns[chunk.run.piece]
        of_base = [-chunk.H[:, j] * base[j] for j in range(d)]
        of_force = [np.where(np.arange(len(channels))[:, None] == i, channels, 0.0) for i in range(n, len(channels))]
        for pull, error in zip(pulls, of_base + of_force, strict=False):  # without a force its moves stay zero
            products = at.products(chunk.sums_of_errors(fit.levels, at, error), chunk.deviations(fit.levels)[0][:, 0])
            pull[at.unknowns] += products.gradient
    moves = np.zeros((model.index.size, n + 2 * d))
    moves[: model.kept] = np.hstack([of_constants, half @ (half.T @ pulls.T)])[: model.kept]
    by_sensor = moves[model.index.phi].reshape(n, -1, n + 2 * d)
    by_sensor[np.arange(n), :, np.arange(n)] += p.modes.phi
    return moves


def _rigid(fit: RecordFit, beyond: float) -> tuple[Array, Array]:
    """Share of the base's motion in each sensor beside what G says, of wrong axes among it, and its chi-squared."""
    chosen, (n, d) = _asked_of_gains(fit), fit.test.rigid_body.shape
    equations, at = fit.equations.at(chosen), chosen.size - 3 * n * d
    normal, size = unit_diagonal(equations.normal)
    half, asked = half_inverse(normal, ROUND_OFF), slice(at, at + n * d)
    step = (half @ (half.T @ (equations.gradient / size)))[asked].reshape(n, d)
    step += fit.of_axes * size[asked].reshape(n, d)
    inverse_rows = half[asked].reshape(n, d, -1)
    covariance = beyond / 2 * inverse_rows @ inverse_rows.swapaxes(1, 2)
    chi2 = np.einsum("ni,nij,nj->n", step, np.linalg.pinv(covariance, rcond=ROUND_OFF, hermitian=True), step)
    return step / size[asked].reshape(n, d), chi2


def delays_left(fit: RecordFit, near: float = 0.3, *, missed: float = _MISSED) -> Array | None:
    """Delays of sensors and force that a step of all unknowns from the end of a fit finds beyond chance, s, or None.

    Those that were taken off already move too, where they are off by more than `near` of their deviation. Deviations
    are `missed` times as large where what is left is no white noise.
    """
    step, covariance = _delays(fit, np.eye(fit.asked.size - fit.asked.delays), missed)
    told = np.flatnonzero(np.diag(covariance))
    found = delays_beyond_chance(step[told], covariance[np.ix_(told, told)], least_delay(fit.test))
    if found is not None:
        return found.at(told, step.size).values
    more, deviations = left_of_clocks(fit, missed)
    return more if np.any(np.abs(more) > near * deviations) else None


def left_of_clocks(fit: RecordFit, missed: float = _MISSED) -> tuple[Array, Array]:
    """What a step of all unknowns finds left of delays that were taken off, s, (k,), alike on one clock; deviations."""
    late, _ = _taken(fit)
    more, covariance = _delays(fit, late, missed)
    return late @ more, late @ np.sqrt(np.diag(covariance))


def delays_beside_dampers(fit: RecordFit) -> Array:
    """Those that show beside any dampers between the modes too, which turn residues as they do, s; zero for none."""
    coupled = replace(fit.parameters, coupling=np.zeros((fit.model.m, fit.model.m)))
    marginal = None if fit.model.whole.grows else delays_left(replace(fit, parameters=coupled))
    if marginal is None:
        return np.zeros(fit.asked.size - fit.asked.delays)
    found = delays_left(fit)
    return marginal if found is None or np.any((found != 0) != (marginal != 0)) else found


def with_shared_clocks(fit: RecordFit, late: Array) -> Array:
    """Delays, s, (k,), with those of channels that a late one's explains better than none, as on one clock with it.

    Of a channel that tells its own delay badly, dampers and modes can take the place; it is one number with the other.
    """
    step, covariance = _delays(fit, np.eye(late.size))
    known, each = late != 0, np.unique(late)  # 0 among them
    across = covariance[np.ix_(~known, known)] @ np.linalg.pinv(covariance[np.ix_(known, known)], hermitian=True)
    others = step[~known] - across @ (step - late)[known]
    shared = late.copy()
    shared[~known] = each[np.argmin(np.abs(others[:, None] - each), axis=1)]
    return np.where(np.diag(covariance) > 0, shared, late)


def delays_of(fit: RecordFit) -> Delays:
    """Delays that were taken off the records of a fit, with their errors at its end."""
    taken = fit.model.whole.taken
    if taken is None:
        return Delays.none(fit.test)
    return Delays(taken, left_of_clocks(fit)[1], _taken(fit)[1])


def _taken(fit: RecordFit) -> tuple[Array, bool]:
    """Columns (k, q) of delays that were taken off, one of channels that share a clock; and whether all are late."""
    taken = fit.model.whole.taken
    if taken is None:
        return np.zeros((fit.asked.size - fit.asked.delays, 0)), False
    of_base = taken.size > 1 and bool(np.all(taken == taken[0]))
    return np.asarray(taken[:, None] == np.unique(taken[taken != 0]), dtype=float), of_base


def _delays(fit: RecordFit, along: Array, missed: float = _MISSED) -> tuple[Array, Array]:
    """Step of delays along columns (k, q) of all of them, s, and its covariance; zero where nothing tells them.

    Where what is left is no white noise the model misses something, which delays make up for as far as they can.
    """
    at, first = fit.model.size, fit.asked.delays
    turn = np.zeros((fit.asked.size, at + along.shape[1]))
    turn[:at, :at], turn[first:, at:] = np.eye(at), along
    normal, size = unit_diagonal(turn.T @ fit.equations.normal @ turn)
    half = half_inverse(normal, ROUND_OFF)
    step, rows = half @ (half.T @ (turn.T @ fit.equations.gradient / size)), half[at:] / size[at:, None]
    beyond = missed**2 if _missed(fit) else 1.0
    return step[at:] / size[at:], beyond * max(fit.reduced, 1.0) / 2 * rows @ rows.T
