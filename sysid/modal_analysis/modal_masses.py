"""Modal masses and rigid-body mass by a measured base force: a small linear problem."""

from __future__ import annotations

import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.response import columns, gains
from sysid.structure.structure import Array


def weigh(test: Measurement, modes: Modes, ends: Array | None = None) -> tuple[Array, Array]:
    """Modal masses t (m,) > 0 and rigid-body mass (d, d): the base force is linear in both.

    Parameters
    ----------
    test : Measurement
    modes : Modes
    ends : (m, inputs - d), optional
        What motion at the ends of whole records pushes each mode by, see `Measurement.inputs`.

    Raises
    ------
    InputError
        Where the force wants negative masses: a wrong sign.
    """
    from scipy.optimize import lsq_linear

    d, m = test.n_base, modes.omega.size
    assert test.force is not None
    base, force = columns(test.base), columns(test.force)
    g = np.tile(gains(test.freq, modes.omega, modes.ratios), test.n_runs)
    pairs = [(i, j) for i in range(d) for j in range(i, d)]
    pushes = (modes.gamma @ base if ends is None else np.hstack([modes.gamma, ends]) @ columns(test.inputs)) * g
    parts = [np.outer(modes.gamma[k], pushes[k]) for k in range(m)]
    for i, j in pairs:
        unit = np.zeros((d, d))
        unit[i, j] = unit[j, i] = 1.0
        parts.append(unit @ base)
    # Moments and forces count in units of their own records.
    size = np.linalg.norm(force, axis=1, keepdims=True)
    size[size == 0] = 1.0
    design = np.array([(part / size).ravel() for part in parts]).T
    wanted = (force / size).ravel()
    scale = np.linalg.norm(design, axis=0)
    scale[scale == 0] = 1.0
    stacked = np.vstack([design.real, design.imag]) / scale
    target = np.concatenate([wanted.real, wanted.imag])
    lower = np.concatenate([np.zeros(m), np.full(len(pairs), -np.inf)])
    # The triangular factor stands for all lines.
    Q, R = np.linalg.qr(stacked)
    plain = Q.T @ target
    free = np.linalg.lstsq(R, plain, rcond=None)[0]
    strength = np.abs(free[:m])
    if np.sum(free[:m] * strength) < -0.5 * np.sum(strength**2):
        raise InputError(
            "the base force answers to the modes with negative masses: check its sign (it is the base's on the "
            "structure, in phase with the base acceleration at low frequency)"
        )
    answer = (free if np.all(free[:m] > 0) else lsq_linear(R, plain, (lower, np.inf), tol=1e-14).x) / scale
    rigid = np.zeros((d, d))
    for (i, j), mass in zip(pairs, answer[m:], strict=True):
        rigid[i, j] = rigid[j, i] = mass
    t = answer[:m]
    return np.maximum(t, 1e-9 * t.max()), rigid
