"""The formulas of docs/theory.md, each against numbers that do not come from it."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import eigh, eigvalsh, solve_triangular
from scipy.stats import ortho_group

import sysid
from sysid.models.mass import sampling_exponent
from sysid.models.spectrum import nearest_factors

N, D = 4, 2
RATIOS = np.array([0.01, 0.02, 0.03, 0.015])
FREQ = np.linspace(5.0, 60.0, 9)
OMEGA = 2 * np.pi * FREQ


def matrices():
    rng = np.random.default_rng(0)
    a, b, G = rng.standard_normal((N + D, N + D)), rng.standard_normal((N, N)), rng.standard_normal((N, D))
    M, K_SS = a @ a.T + np.eye(N + D), 1e4 * (b @ b.T + np.eye(N))
    return M, K_SS, G


def whole(K_SS, G):
    return np.block([[K_SS, -K_SS @ G], [-G.T @ K_SS, G.T @ K_SS @ G]])


M, K_SS, G = matrices()
M_SS, M_S0, M_00 = M[:N, :N], M[:N, N:], M[N:, N:]
B, R = M_SS @ G + M_S0, np.vstack([G, np.eye(D)])
LAM, PHI = eigh(K_SS, M_SS)
W, GAMMA, P = np.sqrt(LAM), PHI.T @ B, np.linalg.inv(PHI)
C = P.T @ np.diag(2 * RATIOS * W) @ P
TRUTH = sysid.Structure(M, whole(K_SS, G), RATIOS, n_base=D)


def gains(omega):
    return omega**2 / (LAM - omega**2 + 2j * RATIOS * W * omega)


def test_equation_of_motion_modal_sum_and_base_force_are_one():
    """They agree with structure and base as one system in absolute motion, which needs neither B nor modes."""
    damping = whole(C, G)
    given, force = TRUTH.transmissibility(FREQ), TRUTH.base_force(FREQ)
    for at, w in enumerate(OMEGA):
        dynamic = -(w**2) * M + 1j * w * damping + whole(K_SS, G)
        absolute = -np.linalg.solve(dynamic[:N, :N], dynamic[:N, N:])  # no force on the structure, a unit base motion
        a = np.linalg.solve(-(w**2) * M_SS + 1j * w * C + K_SS, w**2 * B)
        np.testing.assert_allclose(a + G, absolute, atol=1e-10)
        np.testing.assert_allclose(PHI @ np.diag(gains(w)) @ GAMMA, a, atol=1e-10)
        np.testing.assert_allclose(given[:, :, at], absolute, atol=1e-10)
        held = (dynamic[N:, :N] @ absolute + dynamic[N:, N:]) / -(w**2)  # per unit acceleration
        scale = np.abs(held).max()
        np.testing.assert_allclose(B.T @ a + R.T @ M @ R, held, atol=1e-10 * scale)
        np.testing.assert_allclose(force[:, :, at], held, atol=1e-10 * scale)


def test_effective_masses_and_rigid_body_mass_tell_whether_the_mass_is_semidefinite():
    left = R.T @ M @ R - GAMMA.T @ GAMMA
    np.testing.assert_allclose(left, M_00 - M_S0.T @ np.linalg.solve(M_SS, M_S0), atol=1e-9)
    for share, definite in ((0.5, True), (1.5, False)):
        lighter = M.copy()
        lighter[N:, N:] -= share * eigvalsh(left)[0] * np.eye(D)
        assert (eigvalsh(lighter)[0] > 0) == definite


def test_other_modal_masses_answer_alike_but_for_the_force():
    t = np.array([0.5, 0.8, 1.7, 1.2])
    mass = P.T @ np.diag(t) @ P
    coupling = P.T @ np.diag(t) @ (GAMMA - P @ G)
    stiffness = P.T @ np.diag(t * LAM) @ P
    below = coupling.T @ np.linalg.solve(mass, coupling) + np.eye(D)
    other = sysid.Structure(
        np.block([[mass, coupling], [coupling.T, below]]), whole(stiffness, G), RATIOS, n_base=D
    )  # fmt: skip
    np.testing.assert_allclose(other.transmissibility(FREQ), TRUTH.transmissibility(FREQ), atol=1e-10)
    np.testing.assert_allclose(other.damping, P.T @ np.diag(2 * RATIOS * W * t) @ P, rtol=1e-9, atol=1e-6)
    assert np.abs(mass - M_SS).max() > 0.1 * np.abs(M_SS).max()
    by_t = [(t * gains(w) * GAMMA.T) @ GAMMA + other.rigid_body_mass for w in OMEGA]
    np.testing.assert_allclose(np.moveaxis(other.base_force(FREQ), -1, 0), by_t, rtol=1e-9)
    assert eigvalsh(other.rigid_body_mass - (t * GAMMA.T) @ GAMMA)[0] > 0


def test_rigid_body_motion_is_that_of_a_turned_arm():
    point, way, turn = np.array([0.3, -1.2, 2.0]), np.array([0.6, 0.0, 0.8]), np.array([1.0, -2.0, 0.5])
    expected = np.concatenate([way, np.cross(point, way)])
    row = sysid.rigid_body([point], [way], base_axes="x y z rx ry rz")[0]
    np.testing.assert_allclose(row, expected)
    np.testing.assert_allclose(expected[3:] @ turn, way @ np.cross(turn, point))  # velocity of a point that turns


@pytest.mark.parametrize("k", [1, 3, 8])
def test_mended_equation_20_meets_equation_19_and_the_printed_one_does_not(k):
    def integral(alpha):
        return 2 * quad(lambda x: (1 - (1 - x) ** alpha) ** 2, 0, 1)[0]

    mended = (3 + np.sqrt(1 + 16 * k)) / (4 * (2 * k - 1))
    assert sampling_exponent(k) == pytest.approx(mended) and integral(mended) == pytest.approx(1 / k)
    assert abs(integral(2 * mended) - 1 / k) > 0.3 / k
    if k == 1:
        assert [round(x, 3) for x in (mended, 2 * mended, integral(2 * mended))] == [1.781, 3.562, 1.369]


def test_scaled_stiffness_has_the_frequencies_and_eigenvectors_of_the_modes():
    L = np.linalg.cholesky(M)[:N, :N]
    H = solve_triangular(L, solve_triangular(L, K_SS, lower=True).T, lower=True)
    lam, psi = eigh(H)
    np.testing.assert_allclose(lam, LAM)
    shapes = solve_triangular(L.T, psi)
    np.testing.assert_allclose(np.abs(shapes), np.abs(PHI), rtol=1e-8)
    np.testing.assert_allclose(shapes.T @ K_SS @ shapes, np.diag(LAM), atol=1e-8 * LAM[-1])
    printed = solve_triangular(L.T, solve_triangular(L.T, K_SS).T)  # with the same factor on both sides, transposed
    assert np.abs(eigvalsh(printed) / LAM - 1).max() > 0.1
    np.testing.assert_allclose(TRUTH.damping, C, rtol=1e-8, atol=1e-6)


def test_closed_form_is_the_nearest_matrix_with_the_measured_frequencies():
    factor = np.tril(np.random.default_rng(3).standard_normal((N, N)))
    np.fill_diagonal(factor, np.abs(np.diag(factor)) + 1)
    H, targets = factor @ factor.T, np.array([0.7, 1.3, 2.0, 3.1])
    psi = eigh(H)[1]
    nearest = psi @ np.diag(targets**2) @ psi.T
    refined = nearest_factors(factor[None], targets)[0]
    np.testing.assert_allclose(refined @ refined.T, nearest, atol=1e-10)
    least = np.linalg.norm(nearest - H)
    turns = ortho_group.rvs(N, size=200, random_state=0)
    assert all(np.linalg.norm(q @ np.diag(targets**2) @ q.T - H) >= least for q in turns)


def test_the_transform_of_a_record_in_motion_is_exact():
    """A mode under a base motion exp(s t), from any state: its record is a sum of exponentials, transformed by hand."""
    w, zeta, gamma, T = 11.0, 0.03, 0.7, 9.7
    pole = w * (-zeta + 1j * np.sqrt(1 - zeta**2))
    drive = -0.05 + 8.3j
    forced = -gamma / (drive**2 + 2 * zeta * w * drive + w**2)  # q'' + 2 zeta w q' + w² q = -gamma u''
    parts = [(0.4 - 0.2j, pole), (0.1 + 0.3j, pole.conjugate()), (forced, drive)]
    step = [sum(c * s**order * (np.exp(s * T) - 1) for c, s in parts) for order in (0, 1)]
    lines = 2 * np.pi * np.arange(1, 40) / T

    def transform(c, s):
        return c * (np.exp((s - 1j * lines) * T) - 1) / (s - 1j * lines)

    below = w**2 - lines**2 + 2j * zeta * w * lines
    alpha, beta = w**2 * step[1], w**2 * step[0] + 2 * zeta * w * step[1]
    page = gamma * lines**2 / below * transform(1.0, drive) + (alpha + 1j * lines * beta) / below
    np.testing.assert_allclose(page, sum(transform(c * s**2, s) for c, s in parts), rtol=1e-10)


def test_errors_have_the_covariance_of_all_channels():
    rng, draws = np.random.default_rng(5), 40_000
    T = np.array([[1.0 + 0.5j, 0.2], [-0.3j, 2.0], [4.0, 1.0 - 1.0j]])
    response, base = np.array([0.3, 0.5, 2.0]), np.array([0.4, 0.1])

    def noise(std):
        return std[:, None] * (rng.standard_normal((2, std.size, draws)).T @ [1, 1j] / np.sqrt(2)).T

    e = noise(response) - T @ noise(base)
    S = np.diag(response**2) + T @ np.diag(base**2) @ T.conj().T
    found = e @ e.conj().T / draws
    scale = np.sqrt(np.outer(np.diag(S), np.diag(S)).real)
    assert np.abs((found - S) / scale).max() < 5 / np.sqrt(draws)


def test_matrices_at_a_level_move_one_mode_alone():
    w, zeta, k = 0.9 * W[1], 0.05, 1
    shape = np.outer(P[k], P[k])  # M phi phi' M
    np.testing.assert_allclose(shape, M_SS @ np.outer(PHI[:, k], PHI[:, k]) @ M_SS, rtol=1e-9)
    K_A, C_A = K_SS - (W[k] ** 2 - w**2) * shape, C + 2 * (zeta * w - RATIOS[k] * W[k]) * shape
    poles = np.linalg.eigvals(
        np.block([[np.zeros((N, N)), np.eye(N)], [-np.linalg.solve(M_SS, np.hstack([K_A, C_A]))]])
    )
    omega, ratios = (np.where(np.arange(N) == k, new, old) for new, old in ((w, W), (zeta, RATIOS)))
    expected = omega * (-ratios + 1j * np.sqrt(1 - ratios**2))
    np.testing.assert_allclose(np.sort_complex(poles[poles.imag > 0]), np.sort_complex(expected), rtol=1e-9)
