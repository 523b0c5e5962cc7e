"""Modal masses and rigid-body mass by a measured base force: a small linear problem."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.modal_fit import Modes
from sysid.modal_analysis.response import columns, gains, stacked
from sysid.structure.structure import Array, ComplexArray

_TURNED = 0.25  # of what a base force leaves; of one with a wrong sign less is left when it is turned
_MOST = 0.5  # of the power of a base force, the least that a fit must explain to tell its sign


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
    rows = np.vstack([design.real, design.imag]) / scale
    target = np.concatenate([wanted.real, wanted.imag])
    lower = np.concatenate([np.zeros(m), np.full(len(pairs), -np.inf)])
    # The triangular factor stands for all lines.
    Q, R = np.linalg.qr(rows)
    plain = Q.T @ target
    free = np.linalg.lstsq(R, plain, rcond=None)[0]
    negative = np.sum(free[:m] * np.abs(free[:m])) < -0.5 * np.sum(free[:m] ** 2)
    together = negative and _fits_turned(R, plain, range(m))
    _check_signs(test, modes.gamma, pushes, force / size, bool(together))
    answer = (free if np.all(free[:m] > 0) else lsq_linear(R, plain, (lower, np.inf), tol=1e-14).x) / scale
    rigid = np.zeros((d, d))
    for (i, j), mass in zip(pairs, answer[m:], strict=True):
        rigid[i, j] = rigid[j, i] = mass
    t = answer[:m]
    return np.maximum(t, 1e-9 * t.max()), rigid


def _fits_turned(X: Array, wanted: Array, masses: Sequence[int]) -> bool:
    """True where a force of the other sign is much better explained by unknowns of which `masses` are not negative.

    Of modes far below all lines free masses cancel each other and the base's, and their signs say nothing.
    """
    from scipy.optimize import lsq_linear

    lower = np.full(X.shape[1], -np.inf)
    lower[list(masses)] = 0.0
    Q, R = np.linalg.qr(X)
    left = []
    for sign in (1.0, -1.0):
        found = lsq_linear(R, Q.T @ (sign * wanted), (lower, np.inf), method="bvls").x
        left.append(np.sum((X @ found - sign * wanted) ** 2))
    return bool(left[1] < _TURNED * left[0])


def _check_signs(test: Measurement, gamma: Array, pushes: ComplexArray, force: ComplexArray, together: bool) -> None:
    """Refuse a base force (d, lines) that wants negative masses, `together` or in one direction taken by itself.

    In each direction the modes, by the squares of their shares, and the rigid-body mass must be negative in a fit that
    explains most of the force: what is hardly moved says nothing.
    """
    base, wrong = columns(test.base), []
    for i in range(test.n_base):
        design = np.vstack([gamma[:, i, None] * pushes, base])
        scale = np.linalg.norm(design, axis=1)
        scale[scale == 0] = 1.0
        X, wanted = stacked(design / scale[:, None]), stacked(force[i : i + 1])[:, 0]
        found = np.linalg.lstsq(X, wanted, rcond=None)[0]
        masses, rigid = found[: len(gamma)], found[len(gamma) + i]
        explained = np.sum((X @ found) ** 2) > _MOST * np.sum(wanted**2)
        negative = rigid < 0 and np.sum(masses * np.abs(masses)) < -0.5 * np.sum(masses**2)
        if explained and negative and _fits_turned(X, wanted, [*range(len(gamma)), len(gamma) + i]):
            wrong.append(test.base_axes[i] if test.base_axes else f"base direction {i + 1}")
    if together or wrong:
        where = f" in {' and '.join(wrong)}" if 0 < len(wrong) < test.n_base else ""
        raise InputError(
            f"the base force{where} answers to the modes with negative masses: check its sign (it is the base's on the "
            "structure, in phase with the base acceleration at low frequency)"
        )
