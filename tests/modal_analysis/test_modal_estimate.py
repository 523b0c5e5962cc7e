"""Modes of whole records as statistics: remainders that are no negative mass, and rows in any scale."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import minimize

import sysid
from sysid.measurement.whole import NoiseLevels
from sysid.modal_analysis.modal_estimate import (
    Gains,
    ModalEstimate,
    independent_rows,
    index_of,
    information_about,
    matched,
    misfit_rows,
    shifts_about,
    theta_of,
)  # fmt: skip
from sysid.modal_analysis.modal_fit import Modes
from sysid.models.spectrum import SOLVED
from sysid.nlp import IterationMonitor, NonlinearProgram
from sysid.search.modal_program import solve_modes
from sysid.structure.structure import Array


def _estimate(d: int, share: float, seed: int = 1) -> ModalEstimate:
    """Three modes; the rigid-body mass is `share` of what they carry, coupled to all by the information."""
    r = np.random.default_rng(seed)
    n, m = 2, 3
    size = n * m + m * d + 2 * m + d * (d + 1) // 2
    root = r.normal(size=(size + 5, size))
    gamma = 3 * r.normal(size=(m, d))
    base = np.ones((1, d, 2))
    test = sysid.Measurement(
        [1.0, 2.0], base, 2 * np.ones((1, n, 2)), force=base, rigid_body=np.eye(d)[np.arange(n) % d],
        response_std=1e-3, force_std=1e-3,
    )  # fmt: skip
    return ModalEstimate(
        test, test, r.normal(size=(n, m)), gamma, np.array([10.0, 25.0, 40.0]), np.array([0.01, 0.02, 0.03]),
        share * gamma.T @ gamma, 1e3 * root.T @ root, NoiseLevels(np.ones(n), np.ones(d), np.ones(d)), 1.0,
        np.ones(1), Gains(np.zeros(n), np.ones(n), 1000, np.zeros((size, n)), np.zeros((n, d)), np.zeros(n)),
    )  # fmt: skip


def _own(estimate: ModalEstimate) -> Array:
    return theta_of(estimate.modes, estimate.rigid, index_of(estimate))


def _solved(estimate: ModalEstimate) -> tuple[Modes, Array]:
    """Where IPOPT ends from an estimate, whose remainder is no negative mass there."""
    modes, size = estimate.modes, np.sqrt(np.diag(estimate.gamma.T @ estimate.gamma))

    def spectrum(z: NonlinearProgram) -> tuple[ca.MX, ca.MX]:
        shift, loss = (z.variable(name, np.zeros(modes.omega.size)) for name in ("frequency", "damping ratio"))
        return ca.DM(modes.omega) * ca.exp(shift), ca.DM(modes.ratios) * ca.exp(loss)

    end = solve_modes(
        estimate, modes, spectrum, unit=size, remainder=estimate.rigid - modes.gamma.T @ modes.gamma,
        monitor=IterationMonitor(None, None),
    )  # fmt: skip
    assert end.status in SOLVED
    return end.modes, end.rigid


@pytest.mark.parametrize("d", [1, 2, 3])
def test_modes_that_leave_positive_mass_stay(d: int) -> None:
    estimate = _estimate(d, 1.05)
    modes, rigid = _solved(estimate)
    np.testing.assert_allclose(theta_of(modes, rigid, index_of(estimate)), _own(estimate), rtol=1e-10)


@pytest.mark.parametrize("d", [1, 3])
def test_a_force_that_weighs_a_tenth_of_the_modes_still_ends_in_a_positive_mass(d: int) -> None:
    modes, rigid = _solved(_estimate(d, 0.1))
    assert np.linalg.eigvalsh(rigid - modes.gamma.T @ modes.gamma)[0] > -1e-9 * np.trace(rigid)


@pytest.mark.parametrize("d", [1, 2, 3])
def test_modes_that_carry_too_much_move_as_little_as_they_must(d: int) -> None:
    estimate = _estimate(d, 0.97)
    modes, rigid = _solved(estimate)
    index, own = index_of(estimate), _own(estimate)
    assert np.linalg.eigvalsh(rigid - modes.gamma.T @ modes.gamma)[0] > -1e-9 * np.trace(rigid)
    root = np.linalg.inv(np.linalg.cholesky(estimate.information)).T
    low, p = np.tril_indices(d), own.size

    def remainder(x: Array) -> Array:  # of theta = own + root z, less L L' with L free: no negative mass
        parts = index.split((own + root @ x[:p])[:, None])
        L = np.zeros((d, d))
        L[low] = x[p:]
        return np.asarray((parts[4][..., 0] - parts[1][..., 0].T @ parts[1][..., 0] - L @ L.T)[low])

    found = minimize(
        lambda x: x[:p] @ x[:p], np.concatenate([np.zeros(p), 0.1 * np.random.default_rng(0).normal(size=low[0].size)]),
        method="SLSQP", constraints={"type": "eq", "fun": remainder}, options={"ftol": 1e-12, "maxiter": 400},
    )  # fmt: skip
    assert found.success
    change = theta_of(modes, rigid, index) - own
    assert change @ estimate.information @ change == pytest.approx(found.fun, rel=0.02)


def _rows(estimate: ModalEstimate, modes: Modes, weighed: bool) -> Array:
    given = [ca.MX(ca.DM(part)) for part in (*modes, estimate.rigid)]
    return np.array(ca.evalf(misfit_rows(estimate, *given, weighed=weighed))).ravel()


def test_rows_are_the_information_form_of_any_difference() -> None:
    estimate = _estimate(2, 1.05)
    modes = Modes(estimate.phi + 0.01, estimate.gamma - 0.02, 1.001 * estimate.omega, 1.1 * estimate.ratios)
    change = theta_of(modes, estimate.rigid, index_of(estimate)) - _own(estimate)
    wanted = pytest.approx(change @ estimate.information @ change, rel=1e-8)
    assert np.sum(_rows(estimate, modes, True) ** 2) == wanted
    turned = modes._replace(phi=-modes.phi, gamma=-modes.gamma)
    assert np.sum(_rows(estimate, turned, True) ** 2) == wanted


def test_without_force_rows_do_not_see_the_scale_of_a_mode() -> None:
    estimate, scale = _estimate(2, 1.05), np.array([2.0, -0.5, 3.0])
    modes = Modes(estimate.phi + 0.01, estimate.gamma - 0.02, estimate.omega, estimate.ratios)
    other = modes._replace(phi=modes.phi / scale, gamma=modes.gamma * scale[:, None])
    np.testing.assert_allclose(_rows(estimate, other, False), _rows(estimate, modes, False), rtol=1e-8)


def test_information_in_another_scale_prices_the_same_change_alike() -> None:
    estimate, scale = _estimate(2, 1.05), np.array([2.0, -0.5, 3.0])
    modes = Modes(estimate.phi / scale, estimate.gamma * scale[:, None], estimate.omega, estimate.ratios)
    index, r = index_of(estimate), np.random.default_rng(0)
    dphi, dgamma = r.normal(size=estimate.phi.shape), r.normal(size=estimate.gamma.shape)
    zero = replace(estimate, phi=dphi, gamma=dgamma, omega=np.ones(3), ratios=np.ones(3), rigid=np.zeros((2, 2)))
    here = _own(zero)
    there = theta_of(Modes(dphi / scale, dgamma * scale[:, None], np.ones(3), np.ones(3)), np.zeros((2, 2)), index)
    price = here @ estimate.information @ here
    assert there @ information_about(estimate, modes)[0] @ there == pytest.approx(price, rel=1e-10)


def test_independent_rows_have_the_deviations_of_the_scatter() -> None:
    """With scatter B the covariance is ``A^-1 B A^-1 / 2``, A the information; without one ``A^-1 / 2``."""
    estimate = _estimate(2, 1.05)
    A = estimate.information
    root = np.random.default_rng(3).normal(size=A.shape)
    for B in (None, root @ root.T):
        R, std = independent_rows(replace(estimate, scatter=B))
        covariance = np.linalg.solve(A, np.linalg.solve(A, A if B is None else B).T) / 2
        moves = R @ covariance @ R.T
        np.testing.assert_allclose(moves, np.diag(std**2), atol=1e-7 * np.abs(moves).max())
        np.testing.assert_allclose(R.T @ R, A, atol=1e-7 * np.abs(A).max())


def test_scatter_and_shifts_in_another_scale_are_of_the_same_changes() -> None:
    """A change of the estimate's parameters, in the other scale, has the same score, and the same share of a gain."""
    estimate, scale, r = _estimate(2, 1.05), np.array([2.0, -0.5, 3.0]), np.random.default_rng(4)
    root, moves = r.normal(size=estimate.information.shape), r.normal(size=(len(estimate.information), 2))
    estimate = replace(estimate, scatter=root @ root.T, gain=replace(estimate.gain, moves=moves))
    other = Modes(estimate.phi / scale, estimate.gamma * scale[:, None], estimate.omega, estimate.ratios)
    index = index_of(estimate)

    def there(theta: Array) -> Array:
        phi, gamma, *rest = (part[..., 0] for part in index.split(theta[:, None]))
        pairs = rest[2][tuple(np.array(index.pairs).T)]
        return np.concatenate([(phi / scale).ravel(), (gamma * scale[:, None]).ravel(), rest[0], rest[1], pairs])

    change = r.normal(size=len(root))
    _, scatter = information_about(estimate, other)
    assert scatter is not None and estimate.scatter is not None
    assert there(change) @ scatter @ there(change) == pytest.approx(change @ estimate.scatter @ change, rel=1e-10)
    np.testing.assert_allclose(shifts_about(estimate, other), np.array([there(one) for one in moves.T]).T, rtol=1e-10)


def test_modes_are_matched_by_the_ratio_of_their_frequencies_each_once() -> None:
    """10, 25 and 40 rad/s among five modes; two that are near 40 do not both go to it."""
    estimate = _estimate(2, 1.05)
    found = matched(estimate, np.array([9.0, 24.0, 26.5, 39.5, 41.0]))
    assert found is not None and found.tolist() == [0, 1, 3]
    found = matched(estimate, np.array([39.0, 41.0, 200.0]))
    assert found is not None and sorted(found.tolist()) == [0, 1, 2]
    assert matched(estimate, np.array([10.0, 25.0])) is None
