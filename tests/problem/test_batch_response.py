"""Responses of many candidates at once against one linear system a line, and against a closed form."""

import numpy as np
import pytest

from sysid.problem.batch import by_lines, by_states

FREQ = np.linspace(0.0, 12.0, 25)


def oscillators(omega, ratios, freq, shift=0.0):
    """Masses without springs between them: ``a = -s² / (w_k² + s² + 2 zeta_k w_k s)`` times the base's own, exact."""
    s = shift + 2j * np.pi * freq
    one = -(s**2) / (omega[:, None] ** 2 + s**2 + 2 * (ratios * omega)[:, None] * s)
    return one[:, None]


def matrices(omega, ratios, masses):
    return np.diag(masses), np.diag(masses * omega**2), np.diag(2 * masses * ratios * omega), masses[:, None]


def chains(count, n, rng):
    T = np.eye(n) - np.eye(n, k=-1)
    M = np.array([np.diag(rng.uniform(1, 3, n)) for _ in range(count)])
    K = np.array([T.T @ np.diag(rng.uniform(500, 5000, n)) @ T for _ in range(count)])
    C = np.array([T.T @ np.diag(rng.uniform(0.1, 30, n)) @ T for _ in range(count)])
    return M, K, C, M @ rng.normal(size=(n, 2))


@pytest.mark.parametrize("shift", [0.0, 3.0])
def test_states_and_lines_solve_the_equations_of_motion(shift):
    """``(M s² + C s + K) v = -B`` and ``a = s² v``."""
    M, K, C, B = chains(5, 4, np.random.default_rng(0))
    s = shift + 2j * np.pi * FREQ[1:]
    for response in (by_states, by_lines):
        v = response(M, K, C, B, FREQ[1:], shift) / s**2
        force = np.stack([(M * x**2 + C * x + K) @ v[..., i] for i, x in enumerate(s)], axis=-1)
        np.testing.assert_allclose(force, -B[..., None] * np.ones(s.size), rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("shift", [0.0, 3.0])
@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-13, 1e-11, 1e-9, 1e-6, 1e-3])
def test_states_at_and_near_critical_damping(off, shift):
    omega, ratios, masses = np.array([16.0, 16.0, 30.0]), np.array([1.0 + off, 1.0 - off, 1.0]), np.array([1.0, 2, 3])
    M, K, C, B = (part[None] for part in matrices(omega, ratios, masses))
    found = by_states(M, K, C, B, FREQ, shift)
    np.testing.assert_allclose(found[0], oscillators(omega, ratios, FREQ, shift), rtol=1e-8)


def test_a_candidate_that_is_solved_by_lines_changes_the_bits_of_no_other():
    rng = np.random.default_rng(1)
    M, K, C, B = chains(6, 3, rng)
    alone = by_states(M, K, C, B, FREQ, 0.0)
    critical = matrices(np.full(3, 16.0), np.ones(3), np.array([1.0, 2.0, 3.0]))
    critical = (*critical[:3], np.repeat(critical[3], 2, axis=1))
    together = by_states(
        *(np.insert(part, 2, one, axis=0) for part, one in zip((M, K, C, B), critical, strict=True)), FREQ, 0.0
    )
    np.testing.assert_array_equal(np.delete(together, 2, axis=0), alone)
    np.testing.assert_allclose(together[2][:, :1], oscillators(np.full(3, 16.0), np.ones(3), FREQ), rtol=1e-9)


def test_resonance_without_damping_is_no_number_and_leaves_the_others_alone():
    """A line at exactly the natural frequency; 2 pi f = 4 pi is a product of powers of two and one rounding."""
    omega = np.array([2 * np.pi * 2.0, 40.0])
    M, K, C, B = (np.array([part, part]) for part in matrices(omega, np.array([0.0, 0.01]), np.ones(2)))
    M[1], K[1] = M[1] / 4, K[1] / 4  # exact
    C[1], B[1] = matrices(omega, np.array([0.1, 0.01]), np.full(2, 0.25))[2:]
    found = by_lines(M, K, C, B, np.array([1.0, 2.0]), 0.0)
    assert np.all(np.isnan(found[0]))
    np.testing.assert_allclose(found[1], oscillators(omega, np.array([0.1, 0.01]), np.array([1.0, 2.0])), rtol=1e-9)
