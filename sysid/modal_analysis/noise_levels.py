"""Levels of the noise of all channels of whole records by maximum likelihood, at given modes.

At a line the errors of the outputs have the covariance ``S = diag(v_y) + T diag(v_u) T'``, T from base to outputs. The
variances maximise ``-sum(log det S + e' S^-1 e)``: a few numbers over thousands of lines, by Fisher scoring of their
logarithms.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from sysid.modal_analysis.modal_model import base_noise, dots
from sysid.modal_analysis.record_model import Parameters, RecordModel
from sysid.modal_analysis.varying_levels import designs
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import NEGLIGIBLE

_SETTLED = 1e-4  # of a level's logarithm
VANISHING = 1e-5  # of a channel's rms: least noise; what the model leaves of folding can show below it
NO_NOISE = 2 * VANISHING  # levels at the least, which the fit's own numbers raise a little, are no noise
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
    least = floors(model)
    share = np.median(levels / least, axis=1, keepdims=True)
    least = least * np.maximum(1.0, _LEAST_SHARE**2 * share)
    found = np.zeros_like(levels)
    for number in range(len(model.whole.samples)):
        D = _designs(model, number, levels.shape[1])
        rows = list(D)
        found[rows] = _of_run([part for part in parts if part.piece in D], D, levels[rows], least[rows])
    return found * _of_noise(model)


def _of_noise(model: RecordModel) -> float:
    """Factor of variances, of which the unknowns of a fit took a part."""
    return model.numbers / max(model.numbers - model.unknowns, model.numbers / 4)


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
        fisher = _likelihood([part for part in parts if part.piece in D], D, x)[2]
        inverse = np.linalg.inv(fisher + NEGLIGIBLE * np.eye(x.size))
        mean = np.mean(list(D.values()), axis=0)
        out.append(np.sqrt(np.einsum("ci,ij,cj->c", mean, inverse, mean)) / 2)
    return np.array(out)


def _parts(model: RecordModel, p: Parameters) -> list[ErrorSpectra]:
    return [ErrorSpectra(chunk.error, chunk.H, chunk.run.density, chunk.run.piece) for chunk in model.chunks(p)]


def _designs(model: RecordModel, number: int, channels: int) -> dict[int, Array]:
    """Matrices from the numbers of a run's levels to their logarithms, piece by piece."""
    runs = [run for run in model.runs if run.number == number]
    varying = model.whole.varying
    varies = np.zeros(channels, bool) if varying is None else varying[number]
    ends = float(runs[0].w[0]), float(runs[-1].w[-1])
    matrices = designs(np.array([np.mean(run.w) for run in runs]), ends, varies)
    return {run.piece: one for run, one in zip(runs, matrices, strict=True)}


class ErrorSpectra(NamedTuple):
    """Some lines: errors (c, L), what passes the base on (c, d, L), density and piece of `Run`."""

    error: ComplexArray
    H: ComplexArray
    density: float
    piece: int


def _of_run(parts: list[ErrorSpectra], D: dict[int, Array], levels: Array, least: Array) -> Array:
    """Variances of the pieces of one run, (pieces, c + d), with logarithms ``D x`` of a few numbers x."""
    every = np.concatenate(list(D.values()))
    x = np.linalg.lstsq(every, np.log(np.maximum(levels, least)).ravel(), rcond=None)[0]
    # A number stands for a channel's lowest level at most.
    lowest = np.min(np.where(every > 0, np.log(least).ravel()[:, None], np.inf), axis=0)
    x = np.maximum(x, lowest)
    value, score, fisher = _likelihood(parts, D, x)
    for _ in range(30):
        size = np.sqrt(np.diag(fisher))
        step = np.linalg.solve(fisher / np.outer(size, size) + 1e-6 * np.eye(size.size), score / size) / size
        step = np.clip(step, -2.0, 2.0)
        while True:
            trial = np.maximum(x + step, lowest)
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
    for error, H, density, piece in parts:
        c, v = error.shape[0], density * np.exp(D[piece] @ x)
        scale = 1 / np.sqrt(v[:c])
        V, factor = base_noise(H, scale, np.sqrt(v[c:]))
        e = scale[:, None] * error
        inner = np.sum(V.conj() * e, axis=1)
        Ge = e - np.sum(V * inner[:, None], axis=0)
        inverse = np.moveaxis(np.linalg.inv(np.moveaxis(factor, -1, 0)), 0, -1)  # of L, (d, d, L)
        GT = np.einsum("icl,ijl->jcl", V, inverse)
        TGe = np.sum(GT.conj() * e, axis=1)
        TGT = np.eye(len(V))[:, :, None] - np.einsum("kil,kjl->ijl", inverse.conj(), inverse)
        size = error.shape[1]
        diagonal = np.diagonal(factor).real
        value -= float(2 * np.sum(np.log(diagonal)) + size * np.sum(np.log(v[:c])))
        value -= float(np.vdot(e, e).real - np.vdot(inner, inner).real)
        hidden = np.sum(_squares(V), axis=(0, 2))
        excess = [np.sum(_squares(Ge), axis=1) - size + hidden, np.sum(_squares(TGe) - np.diagonal(TGT).T.real, axis=1)]
        score += D[piece].T @ np.concatenate(excess)
        between = np.sum(_squares(GT), axis=2).T
        pairs = np.block([[np.diag(size - 2 * hidden) + _outer_squares(V), between],
                          [between.T, np.sum(_squares(TGT), axis=2)]])  # fmt: skip
        fisher += D[piece].T @ pairs @ D[piece]
    return value, score, fisher


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
