"""Levels of the noise of all channels of whole records by maximum likelihood, at given modes.

At a line the errors of the outputs have the covariance ``S = diag(v_y) + T diag(v_u) T'``, T from base to outputs. The
variances maximise ``-sum(log det S + e' S^-1 e)``: a few numbers over thousands of lines, by Fisher scoring of their
logarithms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from sysid.modal_analysis.modal_model import Run, base_noise, dots
from sysid.modal_analysis.record_model import Parameters, RecordModel
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import NEGLIGIBLE

KNOTS = 5  # frequencies at which a level that varies is a number of its own, evenly in the root of frequency
_SETTLED = 1e-4  # of a level's logarithm
VANISHING = 1e-5  # of a channel's rms: least noise; what the model leaves of folding can show below it
NO_NOISE = 2 * VANISHING  # levels at the least, which the fit's own numbers raise a little, are no noise
_MOST_SHARE = 0.05  # of the signal in the noise: larger ones would explain modes, as of a frame that softens
_LEAST_SHARE = 0.01  # of the median share of noise: with few lines one channel could come out exact, infinitely likely


def floors(model: RecordModel) -> Array:
    """Least variance of a sample of outputs and base directions, (pieces, c + d)."""
    spectra = (np.vstack([run.outputs, run.base]) / np.sqrt(run.density) for run in model.runs)
    power = np.array([np.mean(np.abs(both) ** 2, axis=1) for both in spectra])
    return VANISHING**2 * np.where(power > 0, power, power.max())


def bounded_by_lines(model: RecordModel, levels: Array, beyond: float = 1.1) -> Array:
    """Variances of a sample, (pieces, c + d), at most what the quietest lines of each channel hold.

    Those that are above by less than a factor of `beyond`, as a deviation, stay, as chance makes them; so do levels
    that vary over the lines.
    """
    if model.whole.varying is not None:
        return levels
    both = (np.vstack([run.outputs, run.base]) for run in model.runs)
    most = np.array([quietest(_squares(one) / run.density, 0.1) for one, run in zip(both, model.runs, strict=True)])
    return np.where(levels > beyond**2 * most, np.maximum(most, floors(model)), levels)


def quietest(power: Array, share: float, size: int = 16) -> Array:
    """Mean of squares (channels, lines) of noise that holds as much in the quietest `share` of blocks, (channels,)."""
    blocks = power.shape[1] // size
    if blocks == 0:
        return np.full(len(power), np.inf)
    held = power[:, : blocks * size].reshape(len(power), blocks, size).mean(axis=2)
    # Of noise alone the mean of so many squares is a gamma variable.
    return np.asarray(np.quantile(held, share, axis=1) / (float(scipy.special.gammaincinv(size, share)) / size))


def likeliest_levels(model: RecordModel, p: Parameters, levels: Array) -> Array:
    """Variances of a sample in time of outputs and base directions, (pieces, c + d), from first ones."""
    lines = sum(run.w.size for run in model.runs)
    thin = model.thinned(max(1, -(-lines // 8000)))  # more lines tell a level no better than the fit needs
    parts = _parts(thin, p)
    least, most = floors(model), np.full_like(levels, np.inf)
    share = np.median(levels[:, : least.shape[1]] / least, axis=1, keepdims=True)
    least = least * np.maximum(1.0, _LEAST_SHARE**2 * share)
    if model.whole.grows:
        most[:, least.shape[1] :] = _MOST_SHARE**2
        least = np.hstack([least, np.full_like(least, VANISHING**2)])
    found = np.zeros_like(levels)
    for number in range(len(model.whole.samples)):
        D = _designs(model, number, levels.shape[1])
        rows = list(D)
        bounds = least[rows], most[rows] / _of_noise(model)
        found[rows] = _of_run([part for part in parts if part.run.piece in D], D, levels[rows], bounds)
    return found * _of_noise(model)


def likeliest_profile(model: RecordModel, p: Parameters, levels: Array, shape: Array, beside: Array) -> Array:
    """Likeliest profile of the noise (`SteadyLines`), its logarithm, (n_freq,), at these levels.

    It is `beside` plus a combination of the columns of `shape`.
    """
    every: dict[int, Array] = dict(enumerate(np.split(np.eye(levels.size), len(levels))))
    parts = [(part, part.run.among(model.test.freq)) for part in _parts(model, p)]

    def unlikely(y: Array) -> float:
        profile = np.exp(shape @ y + beside)
        turned = [part._replace(run=part.run._replace(profile=profile[at])) for part, at in parts]
        return -float(_likelihood(turned, every, np.log(levels).ravel())[0])

    found = scipy.optimize.minimize(unlikely, np.zeros(shape.shape[1]), method="BFGS", options={"maxiter": 20})
    return np.asarray(shape @ found.x + beside)


def _of_noise(model: RecordModel) -> float:
    """Factor of variances, of which the unknowns of a fit took a part."""
    return model.numbers / max(model.numbers - model.unknowns, model.numbers / 4)


def rough_levels(model: RecordModel, p: Parameters) -> Array:
    """Variances to begin with: what the first model leaves of the outputs, and the same share of the base."""
    power = np.zeros((3, len(model.runs), model.channels + model.d))  # of errors and records; numbers of lines
    for chunk in model.chunks(p):
        run = chunk.run
        for at, part in enumerate((np.vstack([chunk.error, run.base]), np.vstack([run.outputs, run.base]))):
            power[at, run.number] += np.sum(np.abs(part) ** 2, axis=1) / run.density
        power[2, run.number] += run.w.size
    left, whole, lines = power
    share = np.median(left[:, : model.channels] / np.where(whole > 0, whole, np.inf)[:, : model.channels])
    left[:, model.channels :] *= share
    least = floors(model)
    levels = np.maximum(left / lines, least)
    if not model.whole.grows:
        return levels
    # Where the base moves alike at all lines its two parts are one: the share.
    levels[:, model.channels :] = least[:, model.channels :]
    return np.hstack([levels, np.full_like(levels, 1e-6)])


def plain_levels(model: RecordModel, p: Parameters) -> Array:
    """Variances, likewise, as least squares has them: one of all lines of sensors, one of forces, the base's least."""
    levels, left = floors(model), np.zeros(model.channels)
    for chunk in model.chunks(p):
        left += np.sum(_squares(chunk.error), axis=1)
    lines = sum(run.w.size for run in model.runs)
    beyond = _of_noise(model) / lines
    density = np.array([run.density for run in model.runs])[:, None]
    for part in (slice(0, model.n), slice(model.n, model.channels)):
        if part.stop > part.start:
            levels[:, part] = np.maximum(levels[:, part], beyond * left[part].mean() / density)
    return levels


def level_deviations(model: RecordModel, p: Parameters, levels: Array) -> Array:
    """Standard deviations of the logarithms of levels found, as deviations of a sample, (runs, c + d).

    Large where the records do not tell a level, or not apart from others: of a nearly rigid structure with one sensor
    only the sum of its noise and the base's shows.
    """
    parts, out = _parts(model, p), []
    for number in range(len(model.whole.samples)):
        D = _designs(model, number, levels.shape[1])
        rows, every = list(D), np.concatenate(list(D.values()))
        x = np.linalg.lstsq(every, np.log(levels[rows]).ravel(), rcond=None)[0]
        fisher = _likelihood([part for part in parts if part.run.piece in D], D, x)[2]
        inverse = np.linalg.inv(fisher + NEGLIGIBLE * np.eye(x.size))
        mean = np.mean(list(D.values()), axis=0)
        if model.whole.grows:  # of both parts together
            signal = np.concatenate([part.run.signal for part in parts if part.run.piece in D], axis=1).mean(axis=1)
            both = np.stack(np.split(levels[number], 2)) * [np.ones(signal.size), signal]
            mean = np.hstack([np.diag(part) for part in both / both.sum(axis=0)]) @ mean
        out.append(np.sqrt(np.einsum("ci,ij,cj->c", mean, inverse, mean)) / 2)
    return np.array(out)


def _parts(model: RecordModel, p: Parameters) -> list[ErrorSpectra]:
    return [ErrorSpectra(chunk.error, chunk.H, chunk.run) for chunk in model.chunks(p)]


def _designs(model: RecordModel, number: int, channels: int) -> dict[int, Array]:
    """Matrices from the numbers of a run's levels to their logarithms, piece by piece."""
    runs = [run for run in model.runs if run.number == number]
    varying = model.whole.varying
    varies = np.zeros(channels, bool) if varying is None else varying[number]
    ends = float(runs[0].w[0]), float(runs[-1].w[-1])
    matrices = designs(np.array([np.mean(run.w) for run in runs]), ends, varies)
    return {run.piece: one for run, one in zip(runs, matrices, strict=True)}


class ErrorSpectra(NamedTuple):
    """Some lines: errors (c, L), what passes the base on (c, d, L), and the records there."""

    error: ComplexArray
    H: ComplexArray
    run: Run


def _of_run(parts: list[ErrorSpectra], D: dict[int, Array], levels: Array, bounds: tuple[Array, Array]) -> Array:
    """Variances of the pieces of one run, (pieces, c + d), with logarithms ``D x`` of a few numbers x."""
    least, most = bounds
    every = np.concatenate(list(D.values()))
    x = np.linalg.lstsq(every, np.log(np.maximum(levels, least)).ravel(), rcond=None)[0]
    # A number stands for a channel's lowest level at most.
    lowest = np.min(np.where(every > 0, np.log(least).ravel()[:, None], np.inf), axis=0)
    highest = np.max(np.where(every > 0, np.log(most).ravel()[:, None], -np.inf), axis=0)
    x = np.clip(x, lowest, highest)
    value, score, fisher = _likelihood(parts, D, x)
    grows = parts[0].run.signal is not None
    for _ in range(30):
        # Where a channel's noise has two parts, those on a bound would turn the step of the others.
        free = np.where(score > 0, x < highest, x > lowest) | (not grows)
        size, step = np.sqrt(np.maximum(np.diag(fisher)[free], np.finfo(float).tiny)), np.zeros(x.size)
        # Of two parts of one channel's noise the smaller may hardly show.
        scaled = fisher[np.ix_(free, free)] / np.outer(size, size) + np.diag(1e-6 + 0.1 * grows / size**2)
        step[free] = np.clip(np.linalg.solve(scaled, score[free] / size) / size, -2.0, 2.0)
        while True:
            trial = np.clip(x + step, lowest, highest)
            new = _likelihood(parts, D, trial)
            if new[0] >= value or np.abs(step).max() < _SETTLED:
                break
            step = step / 2
        moved = np.abs(trial - x).max()
        if new[0] >= value:
            x, (value, score, fisher) = trial, new
        if moved < _SETTLED:
            break
    return np.asarray(np.exp(every @ x)).reshape(levels.shape)


def _likelihood(parts: list[ErrorSpectra], D: dict[int, Array], x: Array) -> tuple[float, Array, Array]:
    """Log-likelihood, and its score and Fisher information by the numbers of which variances are made.

    In units of the noise ``S^-1 = I - V V'``, V as many columns as base directions: no matrix of all channels a line.
    """
    value, score, fisher = 0.0, np.zeros(x.size), np.zeros((x.size, x.size))
    for error, H, run in parts:
        c, design, levels = error.shape[0], D[run.piece], np.exp(D[run.piece] @ x)
        v = run._replace(piece=0).variances(levels[None])
        scale = 1 / np.sqrt(v[:c])
        V, factor = base_noise(H, scale, np.sqrt(v[c:]))
        e = scale * error
        inner = np.sum(V.conj() * e, axis=1)
        Ge = e - np.sum(V * inner[:, None], axis=0)
        unit = np.eye(len(V))[:, :, None]
        both = _over(np.concatenate([V, np.broadcast_to(unit, factor.shape)], axis=1), factor)
        GT, inverse = both[:, :c], both[:, c:]  # of L, transposed
        TGe = np.sum(GT.conj() * e, axis=1)
        TGT = unit - np.sum(inverse[:, None].conj() * inverse, axis=2)
        size = error.shape[1]
        diagonal = np.diagonal(factor).real
        value -= float(2 * np.sum(np.log(diagonal)) + size / v.shape[1] * np.sum(np.log(v[:c])))
        value -= float(np.vdot(e, e).real - np.vdot(inner, inner).real)
        hidden = np.sum(_squares(V), axis=0)
        excess = np.vstack([_squares(Ge) - 1 + hidden, _squares(TGe) - np.diagonal(TGT).T.real])
        if run.signal is not None:
            # What each level makes of the variance at each line, by its logarithm, over that variance.
            by = (
                levels[:, None]
                * np.vstack([np.full_like(v, run.density) * run.profile, run.signal])
                / np.tile(v, (2, 1))
            )
            inverse = np.einsum("jcl,jel->cel", V, V.conj())
            inverse[np.arange(c), np.arange(c)] -= 1
            G = np.concatenate([np.concatenate([inverse, GT.swapaxes(0, 1)], axis=1),
                                np.concatenate([GT.conj(), TGT], axis=1)])  # fmt: skip
            score += design.T @ np.sum(by * np.tile(excess, (2, 1)), axis=1)
            fisher += design.T @ np.einsum("il,jl,ijl->ij", by, by, np.tile(_squares(G), (2, 2, 1))) @ design
            continue
        score += design.T @ np.sum(excess, axis=1)
        between, covered = np.sum(_squares(GT), axis=2).T, np.sum(hidden, axis=1)
        pairs = np.block([[np.diag(size - 2 * covered) + _outer_squares(V), between],
                          [between.T, np.sum(_squares(TGT), axis=2)]])  # fmt: skip
        fisher += design.T @ pairs @ design
    return value, score, fisher


def _over(rows: ComplexArray, factor: ComplexArray) -> ComplexArray:
    """X (d, k, L) with ``X L = rows`` at each line, L (d, d, L) the factor of `base_noise`."""
    out = rows.copy()
    for i in reversed(range(len(out))):
        for j in range(i + 1, len(out)):
            out[i] -= out[j] * factor[j, i]
        out[i] /= factor[i, i].real
    return out


def _squares(values: ComplexArray) -> Array:
    """Squares of moduli."""
    return np.asarray(values.real**2 + values.imag**2)


def _outer_squares(V: ComplexArray) -> Array:
    """Squares of the moduli of the entries of ``V V'``, summed over the lines, (c, c), for V (d, c, L)."""
    out = np.zeros((V.shape[1],) * 2)
    for i, one in enumerate(V):
        for j in range(i + 1):
            product = one * V[j].conj()
            out += (2 - (i == j)) * dots(product, product)
    return out


def interpolation_matrix(middles: Array, first: float, last: float) -> Array:
    """Linear interpolation from the values at the `KNOTS` to the middles of segments, (segments, knots)."""
    at = np.linspace(np.sqrt(first), np.sqrt(last), KNOTS)
    return np.array([np.interp(np.sqrt(middles), at, one) for one in np.eye(KNOTS)]).T


def designs(middles: Array, ends: tuple[float, float], varies: NDArray[np.bool_]) -> list[Array]:
    """Matrices from the numbers of a run to the logarithms of all levels, (channels, numbers) a stretch.

    Parameters
    ----------
    middles : (segments,)
        Middles of stretches, rad/s.
    ends : (first, last)
        Lines of the run, rad/s.
    varies : (channels,) of bool
        Channels whose levels vary; others have one number.
    """
    if not np.any(varies):
        return [np.eye(varies.size)] * middles.size
    shape = interpolation_matrix(middles, *ends)
    first = np.concatenate([[0], np.cumsum(np.where(varies, KNOTS, 1))])
    matrices = []
    for row in shape:
        D = np.zeros((varies.size, first[-1]))
        for channel, varying in enumerate(varies):
            D[channel, first[channel] : first[channel + 1]] = row if varying else 1.0
        matrices.append(D)
    return matrices


def extra_numbers(varying: NDArray[np.bool_] | None) -> int:
    """Numbers that varying levels take more than constant ones."""
    return 0 if varying is None else (KNOTS - 1) * int(np.count_nonzero(varying))
