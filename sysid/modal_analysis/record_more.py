"""Further modes of whole records: what the errors of a fit hold of them, weighed by their full covariance.

The noise of the base shows in all channels at once, along what the structure makes of it. A weak mode whose shape is
another stands out of these errors, though in no channel by itself.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.fit_monitor import FitMonitor
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.record_fit import RecordFit, refitted, worth
from sysid.modal_analysis.record_model import Parameters, RecordModel
from sysid.modal_analysis.response import gains
from sysid.modal_analysis.vector_fitting import DAMPED, RAZOR
from sysid.structure.structure import Array
from sysid.structure.thresholds import beyond_chance

_RATIOS = (0.004, 0.012, 0.036)  # damping ratios that are tried
_REACH = 15.0  # half-power widths about a candidate, of lines that are looked at
_PROMISING = 0.7  # of what a mode must be worth, that a few steps show


def with_further_modes(fit: RecordFit, *, monitor: FitMonitor, some: Measurement | None = None) -> RecordFit:
    """The fit with further modes, one after the other, as long as each is worth more than noise.

    Where lines are many, `some` is the test at a few of them, as in `refitted`.
    """
    while True:
        least = least_worth(fit.model)
        p = _candidate(fit, least)
        if p is None:
            return fit
        more = refitted(fit, p, rough=True, some=some, monitor=monitor)
        if more.likelihood - fit.likelihood < _PROMISING * least or np.any(no_modes(more)):
            return fit
        more = refitted(more, more.parameters, some=some, monitor=monitor)
        if more.likelihood - fit.likelihood < least or np.any(no_modes(more)) or np.min(worth(more)) < least:
            return fit
        fit = more
        monitor.keep(fit)


def no_modes(fit: RecordFit) -> NDArray[np.bool_]:
    """True for modes that no structure has, whatever they explain, (m,): too damped, or far narrower than a line."""
    modes = fit.parameters.modes
    narrow = modes.ratios * modes.omega < RAZOR * 2 * np.pi * np.min(fit.model.whole.spacing)
    return np.asarray((modes.ratios >= DAMPED) | narrow)


def least_worth(model: RecordModel) -> float:
    """Least fall of ``e' S^-1 e`` by a mode: more than noise makes of a residue of rank one and a pole, anywhere."""
    inputs = model.d + 2 * len(model.moving)
    return beyond_chance(model.channels + inputs + 1, len(_RATIOS) * model.numbers) / 2


def _candidate(fit: RecordFit, least: float) -> Parameters | None:
    """The parameters with one more mode, where its likeliest residue of rank one is worth more than `least`."""
    model, p = fit.model, fit.parameters
    c, inputs = model.channels, model.d + 2 * len(model.moving)
    best, found = least, None
    errors = [chunk.weighed_errors(fit.levels) for chunk in model.chunks(p)]
    for ratio in _RATIOS:
        ends = 2 * np.pi * fit.test.freq[[0, -1]]
        count = int(np.log(ends[1] / ends[0]) / ratio) + 2
        for omega in np.geomspace(ends[0], ends[1], count):
            gradient, S, U, power = np.zeros((c, inputs)), np.zeros((c, c)), np.zeros((inputs, inputs)), 0.0
            for w, inputs_there, seen, inverse in errors:
                near = slice(*np.searchsorted(w, omega * (1 + np.array([-1, 1]) * 2 * _REACH * ratio)))
                if near.start == near.stop:
                    continue
                g = gains(w[near] / (2 * np.pi), np.array([omega]), np.array([ratio]))[0]
                moved = g * inputs_there[:, near]
                gradient += (seen[:, near] @ moved.conj().T).real
                # So many in a half-power width tell the mean covariance.
                step = max(1, (near.stop - near.start) // int(2 * _REACH * 16))
                strength = step * np.abs(g[::step]) ** 2
                S += np.einsum("cel,l->ce", inverse[:, :, near][:, :, ::step], strength).real
                U += (moved @ moved.conj().T).real
                power += float(np.sum(strength))
            used = np.diag(U) > 0
            if power == 0 or not np.any(used):
                continue
            # The normal matrix of residues is nearly that of the inputs times the mean inverse covariance.
            left, right = _inverse_root(S / power), _inverse_root(U[np.ix_(used, used)])
            u, s, vt = np.linalg.svd(left @ gradient[:, used] @ right)
            if s[0] ** 2 > best:
                push = np.zeros(inputs)
                push[used] = right @ vt[0]
                best, found = float(s[0] ** 2), (float(omega), ratio, left @ u[:, 0] * s[0], push)
    return None if found is None else _with(fit, *found)


def _with(fit: RecordFit, omega: float, ratio: float, shape: Array, push: Array) -> Parameters:
    """Parameters with one more mode."""
    p, model = fit.parameters, fit.model
    n, d = model.n, model.d
    phi, gamma = shape[:n], push[:d]
    if model.force and np.linalg.norm(gamma) > 0:
        # The force weighs the mode: what it answers by is the participation times the same.
        weighed = float(shape[n:] @ gamma / (gamma @ gamma))
        scale = np.sqrt(max(weighed, 1e-3 * float(np.linalg.norm(shape[n:]) / np.linalg.norm(gamma)), 1e-300))
        phi, gamma, push = phi / scale, gamma * scale, push * scale
    modes = p.modes
    more = Modes(
        np.column_stack([modes.phi, phi]), np.vstack([modes.gamma, gamma]), np.append(modes.omega, omega),
        np.append(modes.ratios, ratio),
    )  # fmt: skip
    return Parameters(more, p.rigid, np.vstack([p.ends, push[d:]]), p.traces)


def _inverse_root(matrix: Array) -> Array:
    lam, V = np.linalg.eigh(matrix)
    some = lam > 1e-10 * lam[-1]
    return (V[:, some] / np.sqrt(lam[some])) @ V[:, some].T
