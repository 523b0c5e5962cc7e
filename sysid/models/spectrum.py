"""Eigenvalue refinement: give ``H = L_H L_H'`` the measured spectrum (Cerini et al. 2024, eq. 31).

Two ways, both from the candidate's own L_H: the closed form, which is the nearest such matrix, and the paper's
nonlinear programme in the entries of L_H, through IPOPT with exact gradient and Hessian.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.models.expressions import triangle, triangle_entries
from sysid.nlp import NumpyFunction, quiet_options
from sysid.structure.structure import Array
from sysid.structure.thresholds import EXACT, NEGLIGIBLE, round_off

SOLVED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")  # IPOPT's statuses that count as success


@dataclass(frozen=True, eq=False)
class Refinement:
    """A factor refined by IPOPT: lower-triangular L_H (n, n), rad/s.

    `error` is the largest relative difference of the replaced eigenvalues from their targets; `status` is IPOPT's own,
    and whether it missed the spectrum.
    """

    factor: Array
    error: float
    success: bool
    status: str


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
    """The closed form: of each ``L_H L_H'`` the nearest matrix (Frobenius) with the target spectrum.

    Lower-triangular L_H (k, n, n) and circular frequencies (m,), m <= n, both rad/s, to refined factors with positive
    diagonals.
    """
    _check(factors, targets)
    lam, psi = np.linalg.eigh(factors @ factors.swapaxes(1, 2))
    # The triangular factor by QR of a square root keeps the small eigenvalues that a Cholesky of H loses.
    upper: Array = np.linalg.qr(np.sqrt(replace_spectrum(lam, targets))[:, :, None] * psi.swapaxes(1, 2))[1]
    signs = np.where(np.diagonal(upper, axis1=1, axis2=2) < 0, -1.0, 1.0)
    return (upper * signs[:, :, None]).swapaxes(1, 2)


def by_ipopt(factor: Array, targets: Array, max_time: float | None = None) -> Refinement:
    """Minimise the distance of the spectrum to the target from the candidate's own factor (the paper's way).

    Eq. 31 is minimised as `SpectrumDistance` has it, over the entries of L_H alone. `max_time` is IPOPT's own, s.
    """
    _check(factor, targets)
    targets = np.sort(targets)
    n, scale = factor.shape[0], targets[-1]
    distance = SpectrumDistance(n, targets / scale)
    rows, columns = np.tril_indices(n)
    lower = np.where(rows == columns, NEGLIGIBLE, -np.inf)
    x, status = minimum(distance, triangle_entries(factor) / scale, lower, max_time)
    refined = triangle(x, n) * scale
    answer = Refinement(refined, spectrum_error(refined, targets), status in SOLVED, status)
    return answer if answer.error < EXACT else replace(answer, success=False, status=f"{status}, spectrum missed")


class SpectrumDistance:
    """Squared relative distance ``sum_k (lam_k / w_k² - 1)²`` of the lowest eigenvalues of ``L_H L_H'`` from targets.

    Eq. 31 itself is the root of a sum of squares, which has no derivative at its own solution. A function of the
    eigenvalues is as smooth as it is symmetric in those that coincide (Lewis and Sendov, SIAM J. Matrix Anal. Appl. 23
    (2001) 368-386): this one where coinciding eigenvalues have the same target, and so at its solutions. With
    f = sum_k f_k(lam_k) and T_jk = psi_j' dH psi_k its second differential in H is ``sum_jk F_jk T_jk²``, F_jk being
    the divided difference of f_j' and f_k' at lam_j and lam_k.

    The targets (m,), m <= n, are circular frequencies, ascending, in the unit of L_H (n, n).
    """

    def __init__(self, n: int, targets: Array) -> None:
        self.rows, self.columns = np.tril_indices(n)
        self._n, self._m = n, targets.size
        self._bend = np.zeros(n)  # of f_k; zero for what has no target
        self._bend[: self._m] = 2 / targets**4
        self._slope = np.zeros(n)  # of f_k at zero
        self._slope[: self._m] = -2 / targets**2
        self._alike = np.equal.outer(self._bend, self._bend)  # with the same target, or none
        self._same = np.equal.outer(self.columns, self.columns)
        self._at: Array = np.full(self.rows.size, np.nan)

    def _decompose(self, x: Array) -> tuple[Array, Array, Array]:
        """L_H, and the eigenvalues and eigenvectors of H; kept for the next call with the same x."""
        if not np.array_equal(x, self._at):
            factor = triangle(x, self._n)
            # Singular values: the least eigenvalues of L L' drown in the round-off of the highest.
            psi, sigma, _ = np.linalg.svd(factor)
            self._at, self._parts = x.copy(), (factor, sigma[::-1] ** 2, psi[:, ::-1])
        return self._parts

    def value(self, x: Array) -> float:
        """The squared distance at entries x of L_H, row by row."""
        lam = self._decompose(x)[1]
        return float(np.sum((-lam * self._slope / 2 - 1)[: self._m] ** 2))

    def gradient(self, x: Array) -> Array:
        """Its gradient, the lower triangle of ``2 Psi diag(f') Psi' L_H``."""
        factor, lam, psi = self._decompose(x)
        full: Array = 2 * ((psi * (self._bend * lam + self._slope)) @ psi.T) @ factor
        return full[self.rows, self.columns]

    def hessian(self, x: Array) -> Array:
        """Its Hessian: the curvature of the distance in H, and that of H in L_H along the slope."""
        factor, lam, psi = self._decompose(x)
        slope, bend = self._bend * lam + self._slope, self._bend
        apart = lam[:, None] - lam
        least = round_off(lam.size) * lam[-1]  # two that coincide and differ in their targets: a kink, very bent
        apart = np.where(np.abs(apart) < least, np.copysign(least, apart), apart)
        divided = np.where(self._alike, bend, (slope[:, None] - slope) / apart)
        sides = psi[self.rows][:, :, None] * (factor.T @ psi)[self.columns][:, None, :]
        turned = (sides + sides.swapaxes(1, 2)).reshape(self.rows.size, -1)  # T of each entry of L_H
        along = 2 * (psi * slope) @ psi.T
        hessian: Array = (turned * divided.ravel()) @ turned.T + along[np.ix_(self.rows, self.rows)] * self._same
        return hessian


def _check(factors: Array, targets: Array) -> None:
    if targets.size > factors.shape[-1]:
        raise InputError(f"{targets.size} target frequencies for a model with {factors.shape[-1]}")


def derivatives_of(distance: SpectrumDistance) -> dict[str, NumpyFunction]:
    """A distance, its gradient and its Hessian as IPOPT asks for them; to be kept for as long as it runs."""
    size = distance.rows.size
    x, none, one = ca.Sparsity.dense(size), ca.Sparsity(0, 0), ca.Sparsity.dense(1)
    return {
        "f": NumpyFunction(lambda at: [distance.value(at)], [x], [one]),
        "grad_f": NumpyFunction(lambda at, _: [distance.value(at), distance.gradient(at)], [x, none], [one, x]),
        "hess_lag": NumpyFunction(
            lambda at, _, weight, __: [ca.triu(ca.DM(float(weight) * distance.hessian(at)))],
            [x, none, one, ca.Sparsity.dense(0, 1)], [ca.Sparsity.upper(size)],
        ),
    }  # fmt: skip


def minimum(distance: SpectrumDistance, start: Array, lower: Array, max_time: float | None) -> tuple[Array, str]:
    """Where IPOPT ends from the entries `start` of L_H, and its status."""
    functions, z = derivatives_of(distance), ca.MX.sym("x", start.size)
    limits = {} if max_time is None else {"max_wall_time": max_time}
    # Relative squares need no scaling of IPOPT's; a slope of 1e-9 leaves errors below that.
    options = quiet_options(300, tol=1e-9, nlp_scaling_method="none", **limits)
    own = {name: functions[name] for name in ("grad_f", "hess_lag")}
    solve = ca.nlpsol("refinement", "ipopt", {"x": z, "f": functions["f"](z)}, {**options, **own})
    end = np.asarray(solve(x0=start, lbx=lower)["x"]).ravel()
    for function in functions.values():
        if function.interrupt is not None:
            raise function.interrupt
    return end, str(solve.stats()["return_status"])


def spectrum_error(factor: Array, targets: Array) -> float:
    """Largest relative difference of the lowest eigenvalues of ``L_H L_H'`` from the squared `targets`."""
    # Singular values, not eigenvalues of L L': full relative accuracy needs no squares.
    singular = np.sort(np.linalg.svd(factor, compute_uv=False))
    return float(np.max(np.abs((singular[: targets.size] / targets) ** 2 - 1)))
