"""Levels of the noise of all channels of whole records by maximum likelihood, at given modes.

At a line the errors of the outputs have the covariance ``S = diag(v_y) + T diag(v_u) T'``, T from base to outputs. The
variances maximise ``-sum(log det S + e' S^-1 e)``: a few numbers over thousands of lines, by Fisher scoring of their
logarithms.
"""

from __future__ import annotations

import numpy as np

from sysid.modal_analysis.record_model import Parameters, RecordModel
from sysid.structure.structure import Array, ComplexArray

_ENOUGH = 8000  # lines, of all runs together: more of them tell a level no better than the fit needs
_STEPS = 30
_SETTLED = 1e-4  # of a level's logarithm
VANISHING = 1e-7  # of a channel's rms: what counts as noise where there is none
_LEAST_SHARE = 0.01  # of the median share of noise: with few lines one channel could come out exact, infinitely likely


def floors(model: RecordModel) -> Array:
    """Least variance of a sample of each run's outputs and base directions, (runs, c + d)."""
    spectra = (np.vstack([run.outputs, run.base]) / np.sqrt(run.density) for run in model.runs)
    power = np.array([np.mean(np.abs(both) ** 2, axis=1) for both in spectra])
    return VANISHING**2 * np.where(power > 0, power, power.max())


def likeliest_levels(model: RecordModel, p: Parameters, levels: Array, unknowns: int) -> Array:
    """Variances of a sample in time of each run's outputs and base directions, (runs, c + d), from first ones.

    Parameters
    ----------
    unknowns : int
        Of the fit, which took a part of the noise with it.
    """
    lines = sum(run.w.size for run in model.runs)
    thin = model.thinned(max(1, -(-lines // _ENOUGH)))
    least = floors(model)
    share = np.median(levels / least, axis=1, keepdims=True)
    least = least * np.maximum(1.0, _LEAST_SHARE**2 * share)
    chunks = list(thin.chunks(p))
    found = np.array([
        _of_run([(part.error, part.H, part.run.density) for part in chunks if part.run.number == run], own, floor)
        for run, (own, floor) in enumerate(zip(levels, least, strict=True))
    ])  # fmt: skip
    return found * model.numbers / max(model.numbers - unknowns, model.numbers / 4)


def _of_run(parts: list[tuple[ComplexArray, ComplexArray, float]], levels: Array, least: Array) -> Array:
    """Variances of one run, (c + d,)."""
    log = np.log(np.maximum(levels, least))
    value, score, fisher = _likelihood(parts, log)
    for _ in range(_STEPS):
        size = np.sqrt(np.diag(fisher))
        step = np.linalg.solve(fisher / np.outer(size, size) + 1e-6 * np.eye(size.size), score / size) / size
        step = np.clip(step, -2.0, 2.0)
        while True:
            trial = np.maximum(log + step, np.log(least))
            new = _likelihood(parts, trial)
            if new[0] >= value or np.abs(step).max() < _SETTLED:
                break
            step = step / 2
        moved = np.abs(trial - log).max()
        if new[0] >= value:
            log, (value, score, fisher) = trial, new
        if moved < _SETTLED:
            break
    return np.asarray(np.exp(log))


def _likelihood(parts: list[tuple[ComplexArray, ComplexArray, float]], log: Array) -> tuple[float, Array, Array]:
    """Log-likelihood, and its score and Fisher information by the logarithms of the variances."""
    value, score, fisher = 0.0, np.zeros(log.size), np.zeros((log.size, log.size))
    v = np.exp(log)
    for error, H, density in parts:
        c = error.shape[0]
        T, e = np.moveaxis(H, -1, 0), error.T
        S = np.einsum("lcd,d,led->lce", T, density * v[c:], T.conj(), optimize=True)
        S[:, np.arange(c), np.arange(c)] += density * v[:c]
        G = np.linalg.inv(S)
        Ge, GT = np.einsum("lce,le->lc", G, e), G @ T
        TGT = np.einsum("lcd,lce->lde", T.conj(), GT)
        TGe = np.einsum("lcd,lc->ld", T.conj(), Ge)
        value -= float(np.sum(np.linalg.slogdet(S)[1]) + np.sum(np.einsum("lc,lc->l", e.conj(), Ge).real))
        own = np.concatenate([np.abs(Ge) ** 2 - np.einsum("lcc->lc", G).real,
                              np.abs(TGe) ** 2 - np.einsum("ldd->ld", TGT).real], axis=1)  # fmt: skip
        score += density * v * own.sum(axis=0)
        between = np.sum(np.abs(GT) ** 2, axis=0)
        pairs = np.block([[np.sum(np.abs(G) ** 2, axis=0), between], [between.T, np.sum(np.abs(TGT) ** 2, axis=0)]])
        fisher += density**2 * np.outer(v, v) * pairs
    return value, score, fisher
