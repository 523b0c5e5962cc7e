"""Absolute motion of the sensors beside all modes: their rigid-body motion and their delay, as recorded.

Absolute accelerations are ``(G + sum of R_k g_k) u_0''``. With poles, residues and a term without poles free, that term
tells what each sensor's row of G would have to be, whatever was stated of it. A record that is late by tau has
``G (1 - i w tau)`` there, to first order, and no structure has a part that grows as ``i w``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.pole_functions import orthonormal
from sysid.modal_analysis.relocation import relocate
from sysid.modal_analysis.residues import Records
from sysid.modal_analysis.rough_poles import decimated_lines, rough_deviations, steady_sine
from sysid.modal_analysis.vector_fitting import GUESS, RAZOR
from sysid.nlp import one_thread
from sysid.structure.structure import Array, ComplexArray
from sysid.structure.thresholds import CANDIDATES, ROUND_OFF, beyond_chance, largest_modulus

_SPARE, _MOST = 6, 40  # poles beyond one a sensor; all of them
_MODE = 0.3  # largest damping ratio of a pole that is kept; what has more answers like a term without poles
_OUTSIDE = 1.5  # times the last line, up to where poles are kept; what lies below the first shows by its tail
_FEW = 0.25  # of the lines


@dataclass(frozen=True, eq=False)
class DirectTerms:
    """Terms without poles of a test's accelerations, and of its base force.

    Attributes
    ----------
    rigid, rigid_std : (n_sensors, d)
        What the sensors move with the base beside all modes, and its standard deviation.
    slope, slope_std : (n_sensors, d), s
        Its part that grows as ``i w``.
    modal : (n_sensors, d)
        Sum of the residues of all modes.
    mass, mass_std : (d, d), kg, or None
        The same of the force: the rigid-body mass.
    modal_mass : (d, d), kg, or None
        Sum of the force's residues: effective masses.
    below : bool
        Modes below the lines show, which answer like a constant too: the terms are not the rigid-body motion alone.
    misfit : float
        Relative residual of the absolute accelerations on all lines; the terms are those without lines far off the fit.
    """

    rigid: Array
    rigid_std: Array
    slope: Array
    slope_std: Array
    modal: Array
    mass: Array | None
    mass_std: Array | None
    modal_mass: Array | None
    below: bool
    misfit: float


def direct_terms(test: Measurement) -> DirectTerms | None:
    """Fit poles, residues and terms without poles; None where lines or base motion do not tell them.

    Noise counts by its deviations where these are stated; a test of whole records is fitted with its transients.
    """
    if test.whole is not None:
        if steady_sine(test) is not None:
            return None
        test = test.at(decimated_lines(test))
        test = replace(test, response_std=rough_deviations(test), force_std=None)
    still = replace(test, rigid_body=np.zeros_like(test.rigid_body), sensors=None)
    with one_thread():
        every = found = _of_accelerations(still)
        for _ in range(3):  # times that lines with spikes are left out
            if found is None or not found[2].spikes.any():
                break
            still = still.at(~found[2].spikes)
            found = _of_accelerations(still)
        if every is None or found is None:
            return None
        omega, ratios, rigid = found
        force = None if test.force is None else _fitted(Records(still, force=True), omega, ratios)
    (const, slope), (const_std, slope_std) = rigid.terms, rigid.std
    mass, mass_std, modal_mass = (None,) * 3 if force is None else (force.terms[0], force.std[0], force.modal)
    return DirectTerms(
        const, const_std, slope, slope_std, rigid.modal, mass, mass_std, modal_mass, rigid.below, every[2].misfit
    )


def _of_accelerations(still: Measurement) -> tuple[Array, Array, _Fit] | None:
    """Poles, and the fit on them; None where the base moves in too few directions, or no pole is found."""
    records = Records(still)
    if not records.unit and records.driven < still.n_base:
        return None
    poles = _poles(records)
    return None if poles is None else (*poles, _fitted(records, *poles))


def _poles(records: Records, steps: int = 8) -> tuple[Array, Array] | None:
    """Poles of the records beside terms without them; none is removed for explaining no more than noise.

    They are looked for in the principal channels, the first half of the steps in few of them, which is quicker.
    """
    lines = 2 * np.pi * records.freq[records.freq > 0]
    inputs = records.base.shape[0]
    room = (records.data.shape[0] // 3 // inputs - 3) // 2  # three real numbers of a channel for each function
    count = min(records.n_sensors + _SPARE, _MOST, room)
    if count < 1:
        return None
    omega, ratios = np.geomspace(lines[0], lines[-1], count), np.full(count, GUESS)
    first, every = records.principal(4), records.principal(12)
    direct = _without_poles(records.freq)
    for step in range(steps):
        omega, ratios = relocate(records, first if 2 * step < steps else every, omega, ratios, lambda: None, direct)
    kept = (omega > lines[0]) & (omega < _OUTSIDE * lines[-1]) & (ratios < _MODE)
    kept &= ratios * omega > RAZOR * np.interp(omega, lines, np.gradient(lines))  # else it answers for one bad line
    return (omega[kept], ratios[kept]) if np.any(kept) else None


def _without_poles(freq: Array) -> ComplexArray:
    """The functions 1, i w and w², the latter two one in size at the last line, (3, n_freq)."""
    x = freq / freq[-1]
    return np.stack([np.ones_like(x) + 0j, 1j * x, x**2 + 0j])


@dataclass(frozen=True, eq=False)
class _Fit:
    """Coefficients of the functions 1 and i w (2, channels, d), their deviations, and the sum of residues.

    Whether modes below the lines show, the relative residual, and lines (n_freq,) that are far off.
    """

    terms: Array
    std: Array
    modal: Array
    below: bool
    misfit: float
    spikes: NDArray[np.bool_]


def _fitted(records: Records, omega: Array, ratios: Array) -> _Fit:
    """Linear least squares on given poles; the slopes per rad/s."""
    direct = records.basis(_without_poles(records.freq), records.driven)
    functions = records.functions(omega, ratios, velocity=True)
    basis, R, size = orthonormal(functions._replace(shared=np.hstack([direct, functions.shared])))
    answered = basis.answers(records.data)
    left = records.data - basis.times(answered)
    inverse = np.linalg.pinv(R, rcond=ROUND_OFF) / size[:, None]
    beta, count = inverse @ answered, len(R)
    first = count - functions.shared.shape[1]  # of the poles, behind the terms without them and those of one run each
    terms = slice(first - direct.shape[1], first)
    freedom = max(len(left) - count, 1)
    level = np.maximum(np.linalg.norm(left, axis=0), ROUND_OFF * np.linalg.norm(records.data, axis=0))
    tail = records.basis(np.maximum(records.freq, records.freq[records.freq > 0][0])[None] ** -2.0 + 0j, records.driven)
    beyond = np.linalg.qr(tail - basis.times(basis.answers(tail)))[0]
    noise = records.noise(left, count * left.shape[1])
    gained = float(np.sum((beyond.T @ left) ** 2))
    shared = noise / records.variance(float(np.sum(left**2)), count * left.shape[1])
    turn = np.array([1.0, 1 / (2 * np.pi * records.freq[-1])])[:, None, None]
    of_terms = lambda x: x.reshape(3, records.driven, -1)[:2]  # noqa: E731
    of_modes = beta[first:].reshape(omega.size, -1, beta.shape[1])[:, : records.driven]
    return _Fit(
        turn * _by_sensor(records, of_terms(beta[terms])),
        turn * _deviations(records, of_terms(inverse[terms]), level * np.sqrt(shared / freedom)),
        _by_sensor(records, of_modes.sum(axis=0, keepdims=True))[0],
        gained > noise * beyond_chance(beyond.shape[1] * left.shape[1], CANDIDATES),
        float(np.linalg.norm(left) / np.sqrt(records.size)),
        _spikes(records, left),
    )  # fmt: skip


def _spikes(records: Records, left: Array) -> NDArray[np.bool_]:
    """Lines (n_freq,) at which a fit leaves a number far off those of its run; none where these are many."""
    size = np.hypot(*left.reshape(2, -1, left.shape[1]))
    level = np.stack([np.median(size[records.run == run], axis=0) for run in range(len(records.blocks))])
    level = np.maximum(level, ROUND_OFF * np.sqrt(records.size / records.data.size))
    spike = largest_modulus(CANDIDATES) / np.sqrt(np.log(2))  # medians of the modulus of noise
    far = records.largest(np.any(size > spike * level[records.run], axis=1)) > 0
    return far if np.count_nonzero(far) < _FEW * far.size else np.zeros_like(far)


def _by_sensor(records: Records, terms: Array) -> Array:
    """Coefficients (k, driven inputs, channels) in the test's own units, (k, n_sensors, d)."""
    plain = terms / records.channel
    if records.unit:
        return plain.reshape(len(terms), -1, records.n_sensors).transpose(0, 2, 1)
    return np.einsum("kic,di->kcd", plain, _of_base(records))


def _deviations(records: Records, rows: Array, level: Array) -> Array:
    """Deviations of the coefficients that rows (k, driven inputs, r) make of r independent errors of each channel.

    Errors of the inputs, which are combinations of base directions, are not independent of one another.
    """
    if records.unit:
        return _by_sensor(records, np.linalg.norm(rows, axis=2)[:, :, None] * level)
    of_base = np.linalg.norm(np.einsum("di,kir->kdr", _of_base(records), rows), axis=2)
    return np.asarray(of_base[:, None] * (level / records.channel)[:, None])


def _of_base(records: Records) -> Array:
    """Combinations of the base directions (d, driven inputs) that the records were fitted on."""
    d = len(records.moving) - (records.base.shape[0] - records.driven)
    return records.moving[:d, : records.driven]
