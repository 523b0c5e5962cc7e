"""Eigenvalue refinement: give ``H = L_H L_H'`` the measured spectrum (Cerini et al. 2024, eq. 31).

Two ways, both from the candidate's own L_H: the closed form, which is the nearest such matrix, and
the paper's nonlinear programme, through IPOPT with exact derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.structure.structure import Array
from sysid.structure.triangular import lower_entries, lower_triangle, triangle, triangle_entries

SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")  # IPOPT's statuses that count as success
_REACHED = 1e-8  # relative error of an eigenvalue up to which it counts as the target
_SECONDS, _POWER = 5.0, 6.5  # of a processor, that the graphs of 14 eigenvalues take, and how that grows with them


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined factor.

    Attributes
    ----------
    factor : (n, n)
        Lower-triangular L_H, rad/s.
    error : float
        Largest relative difference of the replaced eigenvalues from their targets.
    success : bool
    message : str
        The solver's status, or how the closed form went.
    """

    factor: Array
    error: float
    success: bool
    message: str


def replace_spectrum(lam: Array, targets: Array) -> Array:
    """Eigenvalues, ascending along the last axis, with the lowest replaced by the squared `targets`.

    With fewer targets than eigenvalues the highest are left as they are, but not below the
    highest target: the replaced ones stay the lowest.
    """
    squared = np.sort(targets) ** 2
    out = np.maximum(lam, squared[-1])
    out[..., : squared.size] = squared
    return out


def nearest_factors(factors: Array, targets: Array) -> Array:
    """`closed_form` of many factors (k, n, n) at once: their refined factors, with positive diagonals."""
    lam, psi = np.linalg.eigh(factors @ factors.swapaxes(1, 2))
    # The triangular factor by QR of a square root keeps the small eigenvalues that a Cholesky of H loses.
    upper: Array = np.linalg.qr(np.sqrt(replace_spectrum(lam, targets))[:, :, None] * psi.swapaxes(1, 2))[1]
    signs = np.where(np.diagonal(upper, axis1=1, axis2=2) < 0, -1.0, 1.0)
    return (upper * signs[:, :, None]).swapaxes(1, 2)


def closed_form(factor: Array, targets: Array) -> Refinement:
    """The matrix nearest to ``L_H L_H'`` (Frobenius) with the target spectrum: its own eigenvectors.

    Parameters
    ----------
    factor : ndarray, shape (n, n)
        Lower-triangular L_H, rad/s.
    targets : ndarray, shape (m,), m <= n
        Measured circular frequencies, rad/s.
    """
    targets = _check(factor, targets)
    return _finish(nearest_factors(factor[None], targets)[0], targets, True, "closed form")


def seconds_to_begin(n: int) -> float:
    """About how long the graphs of `by_ipopt` take, once for n eigenvalues."""
    return float(_SECONDS * (n / 14) ** _POWER)


def by_ipopt(factor: Array, targets: Array, max_time: float | None = None) -> Refinement:
    """Minimise the distance of the spectrum to the target from the candidate's own factor (the paper's way).

    Eq. 31 is minimised in squares, relative to each target (its square root has no derivative at
    its own solution). Eigenvalues enter as unknowns beside the eigenvectors, tied to L_H by
    ``Psi' Psi = I`` and ``Psi' L_H L_H' Psi = diag(lam)``: polynomials, exact to any derivative, and with
    independent gradients even where eigenvalues repeat, because L_H is free to move. `max_time` is IPOPT's own, s.
    """
    targets = _check(factor, targets)
    n, m = factor.shape[0], targets.size
    lam, psi = np.linalg.eigh(factor @ factor.T)
    unit = _units(np.sqrt(np.maximum(lam, np.finfo(float).tiny)), targets)
    scale = unit[-1]
    rows = np.tril_indices(n)
    start = np.concatenate([triangle_entries(factor) / scale, psi.ravel(order="F"), lam / unit**2])
    lower = np.concatenate(
        [
            np.where(rows[0] == rows[1], 1e-6, -np.inf),
            np.full(n * n + m, -np.inf),
            (1 + 1e-6) * (targets[-1] / unit[m:]) ** 2,  # what is not replaced stays above what is
        ]
    )
    solver = _programme(n, m, max_time)
    solution = solver(x0=start, lbx=lower, ubx=np.inf, lbg=0, ubg=0, p=np.concatenate([unit / scale, unit]))
    status = solver.stats()["return_status"]
    refined = triangle(np.asarray(solution["x"]).ravel()[: rows[0].size], n) * scale
    answer = _finish(refined, targets, status in SOLVED, f"IPOPT: {status}")
    return answer if answer.error < _REACHED else replace(answer, success=False)


def _check(factor: Array, targets: Array) -> Array:
    targets = np.sort(np.asarray(targets, dtype=float))
    if targets.size > factor.shape[0]:
        raise InputError(f"{targets.size} target frequencies for a model with {factor.shape[0]}")
    return targets


def _units(own: Array, targets: Array) -> Array:
    """Circular frequency that each eigenvalue is measured in: its target, or its own."""
    return np.concatenate([targets, np.maximum(own[targets.size :], targets[-1])])


@lru_cache(maxsize=16)
def _programme(n: int, m: int, max_time: float | None = None) -> ca.Function:
    """IPOPT programme of n eigenvalues with the lowest m given; parameters: unit / scale, unit (n each)."""
    x = ca.SX.sym("x", n * (n + 1) // 2)
    psi, lam = ca.SX.sym("psi", n, n), ca.SX.sym("lam", n)
    relative, unit = ca.SX.sym("relative", n), ca.SX.sym("unit", n)
    half = lower_triangle(x, n).T @ psi @ ca.diag(1 / relative)
    ties = ca.vertcat(lower_entries(psi.T @ psi - ca.SX.eye(n)), lower_entries(half.T @ half - ca.diag(lam)))
    nlp = {
        "x": ca.vertcat(x, ca.vec(psi), lam),
        "p": ca.vertcat(relative, unit),
        "f": ca.sumsqr(lam[:m] - 1),
        "g": ties,
    }
    options = {
        "print_time": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-13, "constr_viol_tol": 1e-13, "max_iter": 300}
        | ({} if max_time is None else {"max_wall_time": max_time}),
    }
    return ca.nlpsol("refinement", "ipopt", nlp, options)


def _finish(factor: Array, targets: Array, success: bool, message: str) -> Refinement:
    """What came of a refinement, from its factor, whose diagonal is positive."""
    # Singular values, not eigenvalues of L L': full relative accuracy needs no squares.
    own = np.sort(np.linalg.svd(factor, compute_uv=False))
    error = float(np.max(np.abs((own[: targets.size] / targets) ** 2 - 1)))
    return Refinement(factor, error, success, message)
