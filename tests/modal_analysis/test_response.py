"""The residual expression against Structure, its derivatives against a complex step, and linear fits at known poles."""

import dataclasses

import casadi as ca
import numpy as np
import pytest

from sysid import Measurement
from sysid.modal_analysis.residues import linear_residues
from sysid.modal_analysis.response import residual, weighed_mass

SEEDS = range(4)


def measurement(structure, freq, base, relative, force=None):
    """A test of which the *relative* accelerations are given."""
    response = relative + np.einsum("sd,rdf->rsf", structure.rigid_body, base)
    return Measurement(freq, base, response, rigid_body=structure.rigid_body, force=force)


def random_test(rng, structure, *, runs=3, force=True, lines=15):
    """Runs of complex base motion in all directions at once, and records that no structure fits."""
    n, d = structure.n, structure.n_base
    normal = lambda *shape: rng.normal(size=shape) + 1j * rng.normal(size=shape)  # noqa: E731
    freq = np.sort(rng.uniform(2, 70, lines))
    base, relative, pull = normal(runs, d, lines), 3 * normal(runs, n, lines), 50 * normal(runs, d, lines)
    return measurement(structure, freq, base, relative, pull if force else None)


def modal(structure):
    """Arguments of `residual` for a structure, as one vector, and the way back."""
    n, d = structure.n, structure.n_base
    pieces = [
        structure.mode_shapes, structure.participation, 2 * np.pi * structure.natural_frequencies,
        structure.damping_ratios, structure.rigid_body_mass,
    ]  # fmt: skip
    shapes = [(n, n), (n, d), (n, 1), (n, 1), (d, d)]
    return np.concatenate([p.ravel(order="F") for p in pieces]), shapes


def expression(test, shapes, **options):
    z = ca.MX.sym("z", sum(a * b for a, b in shapes))
    ends = np.cumsum([0, *(a * b for a, b in shapes)]).tolist()
    parts = [ca.reshape(z[a:b], *shape) for a, b, shape in zip(ends[:-1], ends[1:], shapes, strict=True)]
    return z, residual(test, *parts, **options)


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("runs", [1, 3])
@pytest.mark.parametrize("seed", SEEDS)
def test_residual_is_the_relative_error_of_the_structures_responses(random_structure, seed, runs, force):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=4, d=int(rng.integers(1, 4)))
    test = random_test(rng, s, runs=runs, force=force)
    values, shapes = modal(s)
    z, miss = expression(test, shapes)
    out = np.asarray(ca.Function("miss", [z], [miss])(values)).ravel()

    A = s.relative_acceleration(test.freq)
    error = [np.einsum("sdf,rdf->rsf", A, test.base) - test.relative]
    error[0] = error[0] / np.linalg.norm(test.relative)
    if force:
        F = s.base_force(test.freq)
        error.append((np.einsum("edf,rdf->ref", F, test.base) - test.force) / np.linalg.norm(test.force))
    assert out.size == 2 * sum(e.size for e in error)
    assert np.sum(out**2) == pytest.approx(sum(np.linalg.norm(e) ** 2 for e in error), rel=1e-11)
    # Entry by entry, real parts then imaginary parts of each record, in any order inside.
    at = 0
    for e in error:
        for part in (e.real, e.imag):
            piece = out[at : at + e.size]
            at += e.size
            np.testing.assert_allclose(np.sort(piece), np.sort(part.ravel()), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("seed", SEEDS)
def test_it_vanishes_at_the_truth(random_structure, seed):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=4, d=2)
    test = random_test(rng, s)
    a = np.einsum("sdf,rdf->rsf", s.relative_acceleration(test.freq), test.base)
    f = np.einsum("edf,rdf->ref", s.base_force(test.freq), test.base)
    values, shapes = modal(s)
    z, miss = expression(measurement(s, test.freq, test.base, a, f), shapes)
    assert np.linalg.norm(np.asarray(ca.Function("miss", [z], [miss])(values))) < 1e-13


@pytest.mark.parametrize("shift", [0.3, 20.0, 150.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_at_complex_frequencies_it_vanishes_at_direct_solves_there(random_structure, seed, shift):
    """(s² M + s C + K) a = -s² B u with s = shift + i w; f = B' a + M_rb u."""
    rng = np.random.default_rng(seed)
    structure = random_structure(rng, n=4, d=2)
    test, n = random_test(rng, structure), structure.n
    M, K, C = structure.mass[:n, :n], structure.stiffness[:n, :n], structure.damping
    B = M @ structure.rigid_body + structure.mass[:n, n:]
    s = shift + 2j * np.pi * test.freq
    Z = s[:, None, None] ** 2 * M + s[:, None, None] * C + K
    u = np.moveaxis(test.base, -1, 0)  # (lines, runs, d)
    a = np.linalg.solve(Z, -(s[:, None, None] ** 2) * (B @ u.swapaxes(1, 2)))
    f = B.T @ a + structure.rigid_body_mass @ u.swapaxes(1, 2)
    a, f = (np.moveaxis(record, (0, 1, 2), (2, 1, 0)) for record in (a, f))
    values, shapes = modal(structure)
    z, miss = expression(measurement(structure, test.freq, test.base, a, f), shapes, shift=shift)
    assert np.linalg.norm(np.asarray(ca.Function("miss", [z], [miss])(values))) < 1e-12


def test_a_modal_gain_at_a_complex_frequency_by_hand():
    """One mass, w = 2, zeta = 1/4, at s = 1 + i: s² = 2i, s² + s + 4 = 5 + 3i, a = -2i / (5 + 3i) = -(6 + 10i) / 34."""
    record = np.array([[[1 - (6 + 10j) / 34]]])
    test = Measurement([1 / (2 * np.pi)], np.ones((1, 1, 1)), record, rigid_body=[[1.0]])
    one = ca.MX(1.0)
    miss = residual(test, one, one, ca.MX(2.0), ca.MX(0.25), one, shift=1.0)
    assert float(ca.evalf(ca.norm_2(miss))) < 1e-14


def numpy_cost(test, shapes):
    """The same sum of squares in NumPy, real records apart, so that it can be stepped into the complex plane."""
    ends = np.cumsum([0, *(a * b for a, b in shapes)])

    def cost(z):
        phi, gamma, omega, zeta, rigid = (
            z[a:b].reshape(shape, order="F") for a, b, shape in zip(ends[:-1], ends[1:], shapes, strict=True)
        )
        w = 2 * np.pi * test.freq
        size = w**2 / ((omega**2 - w**2) ** 2 + (2 * zeta * omega * w) ** 2)
        g = size * (omega**2 - w**2), -size * 2 * zeta * omega * w
        total = 0
        for run in range(len(test.base)):
            u = test.base[run].real, test.base[run].imag
            push = gamma @ u[0], gamma @ u[1]
            q = g[0] * push[0] - g[1] * push[1], g[0] * push[1] + g[1] * push[0]
            for k, part in enumerate((np.real, np.imag)):
                e = (phi @ q[k] - part(test.relative[run])) / np.linalg.norm(test.relative)
                f = (gamma.T @ q[k] + rigid @ u[k] - part(test.force[run])) / np.linalg.norm(test.force)
                total = total + np.sum(e**2) + np.sum(f**2)
        return total

    return cost


@pytest.mark.parametrize("seed", SEEDS)
def test_gradient_is_exact_by_complex_step(random_structure, seed):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=3, d=2)
    test = random_test(rng, s)
    values, shapes = modal(s)
    z, miss = expression(test, shapes)
    f = ca.sumsqr(miss)
    gradient = np.asarray(ca.Function("g", [z], [ca.gradient(f, z)])(values)).ravel()
    cost, h = numpy_cost(test, shapes), 1e-30
    expected = [cost(values + 1j * h * row).imag / h for row in np.eye(values.size)]
    assert float(ca.Function("f", [z], [f])(values)) == pytest.approx(cost(values), rel=1e-12)
    np.testing.assert_allclose(gradient, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_hessian_is_the_difference_of_exact_gradients_with_error_of_second_order(random_structure, seed):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=3, d=2)
    test = random_test(rng, s)
    values, shapes = modal(s)
    z, miss = expression(test, shapes)
    hessian = np.asarray(ca.Function("H", [z], [ca.hessian(ca.sumsqr(miss), z)[0]])(values))
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-12, atol=1e-14 * np.abs(hessian).max())
    cost, tiny = numpy_cost(test, shapes), 1e-30
    slope = lambda at, direction: cost(at + 1j * tiny * direction).imag / tiny  # noqa: E731
    unit = np.maximum(np.abs(values), 0.1)
    a, b = rng.normal(size=(2, values.size)) * unit
    exact = a @ hessian @ b
    errors = [abs((slope(values + h * b, a) - slope(values - h * b, a)) / (2 * h) - exact) for h in (1e-5, 1e-6)]
    size = np.abs(a) @ np.abs(hessian) @ np.abs(b)
    assert errors[1] < 1e-8 * size
    # A tenth of the step, a hundredth of the error, until round-off.
    assert errors[1] < max(errors[0] / 30, 1e-10 * size)


def exact_test(rng, s):
    """Runs of complex base motion with the structure's own answers."""
    test = random_test(rng, s, lines=40)
    a = np.einsum("sdf,rdf->rsf", s.relative_acceleration(test.freq), test.base)
    f = np.einsum("edf,rdf->ref", s.base_force(test.freq), test.base)
    return measurement(s, test.freq, test.base, a, f)


@pytest.mark.parametrize("seed", SEEDS)
def test_at_the_true_poles_linear_least_squares_gives_residues_and_mass(random_structure, seed):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=4, d=int(rng.integers(1, 4)))
    test, omega = exact_test(rng, s), 2 * np.pi * s.natural_frequencies
    residues, left = linear_residues(test, omega, s.damping_ratios)
    expected = np.einsum("sk,kd->ksd", s.mode_shapes, s.participation)
    assert left < 1e-12
    np.testing.assert_allclose(residues, expected, atol=1e-9 * np.abs(expected).max())
    rigid = s.rigid_body_mass
    np.testing.assert_allclose(weighed_mass(test, omega, s.damping_ratios), rigid, atol=1e-8 * np.abs(rigid).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_no_modal_model_with_the_same_poles_fits_better_than_its_free_residues(random_structure, seed):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=4, d=2)
    test = dataclasses.replace(random_test(rng, s, lines=40), force=None, force_std=None)
    _, left = linear_residues(test, 2 * np.pi * s.natural_frequencies, s.damping_ratios)
    assert 0 < left < 1
    for _ in range(20):
        other = random_structure(rng, n=4, d=2, frequencies=s.natural_frequencies, ratios=s.damping_ratios)
        A = np.einsum("sdf,rdf->rsf", other.relative_acceleration(test.freq), test.base)
        assert np.linalg.norm(A - test.relative) > left * np.linalg.norm(test.relative)
