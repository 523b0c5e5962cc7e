"""Direct solves as expressions: against structures, plain NumPy solves and finite differences."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.problem.direct_response import Motion, absolute_response, relative_misfit, relative_response

FREQ = np.linspace(1.0, 70.0, 23)


def motion_of(structure):
    """The matrices of a structure as constant expressions."""
    n = structure.n
    M, C, K = structure.mass, structure.damping, structure.stiffness
    blocks = (M[:n, :n], M[:n, n:], M[n:, n:], K[:n, :n], C)
    return Motion(*(ca.MX(ca.DM(b)) for b in blocks), structure.rigid_body_dofs, structure.recovery)


def numbers_of(*expressions):
    """Values of expressions without symbols."""
    return [np.asarray(ca.densify(value)) for value in ca.Function("f", [], list(expressions)).call([])]


def shaken(rng, structure, freq=FREQ, runs=3, force=True, **options):
    """A test with random complex base motion in all directions at once, and records that no structure makes."""
    d, s = structure.n_base, structure.n_sensors
    base = rng.normal(size=(runs, d, freq.size)) + 1j * rng.normal(size=(runs, d, freq.size))
    record = rng.normal(size=(runs, s, freq.size)) + 1j * rng.normal(size=(runs, s, freq.size))
    pull = rng.normal(size=(runs, d, freq.size)) + 1j * rng.normal(size=(runs, d, freq.size)) if force else None
    axes = ["x", "y", "z", "rx", "ry", "rz"][:d]
    return sysid.Measurement(freq, base, record, rigid_body=structure.rigid_body, force=pull, base_axes=axes, **options)


def side_by_side(per_run):
    """(runs, channels, n_freq) as CasADi has it: the runs side by side."""
    return np.concatenate(list(per_run), axis=1)


def solved(structure, test, shift):
    """Relative accelerations of the degrees of freedom and base force, (channels, runs * n_freq), line by line."""
    n, G = structure.n, structure.rigid_body_dofs
    M, K, C = structure.mass[:n, :n], structure.stiffness[:n, :n], structure.damping
    B = M @ G + structure.mass[:n, n:]
    accelerations, forces = [], []
    for u in test.base:
        a = np.empty((n, test.freq.size), complex)
        f = np.empty((structure.n_base, test.freq.size), complex)
        for i, frequency in enumerate(test.freq):
            s = shift + 2j * np.pi * frequency
            v = np.linalg.solve(s**2 * M + s * C + K, -B @ u[:, i])
            a[:, i] = s**2 * v
            # What pulls at all mass, that of the base included: M times absolute accelerations, summed as a rigid body.
            absolute = np.concatenate([a[:, i] + G @ u[:, i], u[:, i]])
            f[:, i] = np.vstack([G, np.eye(len(u))]).T @ structure.mass @ absolute
        accelerations.append(a)
        forces.append(f)
    return side_by_side(accelerations), side_by_side(forces)


@pytest.mark.parametrize("shift", [0.0, 3.0, 60.0])
@pytest.mark.parametrize(("n", "d"), [(1, 1), (2, 1), (4, 2), (5, 3)])
def test_responses_are_those_of_numpy_at_complex_frequencies(random_structure, n, d, shift):
    rng = np.random.default_rng(100 * n + d)
    structure = random_structure(rng, n, d, damping="matrix")
    test = shaken(rng, structure)
    a, f = relative_response(test, motion_of(structure), shift=shift)
    re, im, f_re, f_im = numbers_of(*a, *f)
    expected, force = solved(structure, test, shift)
    np.testing.assert_allclose(re + 1j * im, expected, rtol=1e-9, atol=1e-11 * np.abs(expected).max())
    np.testing.assert_allclose(f_re + 1j * f_im, force, rtol=1e-9, atol=1e-11 * np.abs(force).max())


@pytest.mark.parametrize("damping", ["matrix", "ratios"])
@pytest.mark.parametrize("d", [1, 2, 3])
def test_responses_and_misfit_are_those_of_the_structure(random_structure, damping, d):
    rng = np.random.default_rng(d)
    structure = random_structure(rng, 4, d, damping=damping)
    test = shaken(rng, structure)
    motion = motion_of(structure)
    a, f = relative_response(test, motion)
    re, im, f_re, f_im = numbers_of(*a, *f)
    expected = np.einsum("sdf,rdf->rsf", structure.relative_acceleration(FREQ), test.base)
    np.testing.assert_allclose(re + 1j * im, side_by_side(expected), rtol=1e-8, atol=1e-10 * np.abs(expected).max())
    pull = np.einsum("edf,rdf->ref", structure.base_force(FREQ), test.base)
    np.testing.assert_allclose(f_re + 1j * f_im, side_by_side(pull), rtol=1e-8, atol=1e-10 * np.abs(pull).max())
    (miss,) = numbers_of(ca.norm_2(relative_misfit(test, motion)))
    np.testing.assert_allclose(miss.item(), np.hypot(test.residual(structure), test.force_residual(structure)))


def test_absolute_responses_add_what_the_base_carries_along(random_structure):
    rng = np.random.default_rng(4)
    structure = random_structure(rng, 4, 3, damping="matrix")
    test = shaken(rng, structure)
    re, im = numbers_of(*absolute_response(test, motion_of(structure)))
    expected = np.einsum("sdf,rdf->rsf", structure.transmissibility(FREQ), test.base)
    np.testing.assert_allclose(re + 1j * im, side_by_side(expected), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("shift", [0.0, 20.0])
def test_sensors_are_combinations_of_degrees_of_freedom(random_structure, random_blocks, shift):
    rng = np.random.default_rng(5)
    M, K, G = random_blocks(rng, 5, 2)
    x = rng.normal(size=(5, 5))
    R = rng.normal(size=(3, 5))
    structure = sysid.Structure(M, K, n_base=2, damping_matrix=5 * x @ x.T, recovery=R, rigid_body=R @ G)
    test = shaken(rng, structure)
    motion = motion_of(structure)
    a, _ = solved(structure, test, shift)
    if not shift:
        re, im = numbers_of(*absolute_response(test, motion))
        np.testing.assert_allclose(
            re + 1j * im, R @ a + side_by_side(np.einsum("sd,rdf->rsf", R @ G, test.base)), rtol=1e-8, atol=1e-9
        )
        (miss,) = numbers_of(ca.norm_2(relative_misfit(test, motion)))
        np.testing.assert_allclose(miss.item(), np.hypot(test.residual(structure), test.force_residual(structure)))
    (miss,) = numbers_of(relative_misfit(test, motion, shift=shift))
    part = (R @ a - side_by_side(test.relative)) / np.linalg.norm(test.relative)
    stacked = np.concatenate([part.real.ravel(order="F"), part.imag.ravel(order="F")])
    np.testing.assert_allclose(miss.ravel()[: stacked.size], stacked, rtol=1e-8, atol=1e-10)


def test_nothing_moves_at_rest_and_the_force_is_that_of_a_rigid_body(random_structure):
    rng = np.random.default_rng(6)
    structure = random_structure(rng, 3, 2, damping="matrix")
    test = shaken(rng, structure, np.array([0.0, 1.0, 2.0]))
    a, f = relative_response(test, motion_of(structure))
    re, im, f_re, f_im = numbers_of(*a, *f)
    lines = slice(None, None, 3)
    assert not np.any(re[:, lines])
    assert not np.any(im[:, lines])
    rigid = structure.rigid_body_mass @ side_by_side(test.base)[:, lines]
    np.testing.assert_allclose((f_re + 1j * f_im)[:, lines], rigid, rtol=1e-12)


def test_without_force_the_misfit_has_the_rows_of_the_accelerations_only(random_structure):
    rng = np.random.default_rng(7)
    structure = random_structure(rng, 3, 2, damping="matrix")
    test = shaken(rng, structure, force=False)
    (miss,) = numbers_of(relative_misfit(test, motion_of(structure)))
    assert miss.size == 2 * test.response.size
    np.testing.assert_allclose(np.linalg.norm(miss), test.residual(structure))


@pytest.mark.parametrize("stated", ["response", "force", "both"])
def test_stated_noise_weighs_channels_and_lines(random_structure, stated):
    rng = np.random.default_rng(8)
    structure = random_structure(rng, 3, 2, damping="matrix")
    channel, line, pull = rng.uniform(0.1, 3, (1, 3, 1)), rng.uniform(0.1, 3, (3, 1, FREQ.size)), rng.uniform(1, 9)
    std = {}
    if stated != "force":
        std["response_std"] = channel * line
    if stated != "response":
        std["force_std"] = np.full((3, 2, FREQ.size), pull)
    test = shaken(rng, structure, **std)
    (miss,) = numbers_of(ca.norm_2(relative_misfit(test, motion_of(structure), weighted=True)))
    left = (test.predict(structure) - test.relative) / std.get("response_std", 1.0)
    size = np.linalg.norm(test.relative / std.get("response_std", 1.0))
    force, force_size = test.predict_force(structure) - test.force, np.linalg.norm(test.force)
    if stated == "both":  # one noise against the other, in units of the weighted accelerations
        force, force_size = force / pull, size
    np.testing.assert_allclose(
        miss.item(), np.hypot(np.linalg.norm(left) / size, np.linalg.norm(force) / force_size), rtol=1e-9
    )


@pytest.mark.parametrize("shift", [0.0, 15.0])
def test_the_jacobian_is_that_of_central_differences(random_structure, random_blocks, shift):
    rng = np.random.default_rng(9)
    n, d = 3, 2
    structure = random_structure(rng, n, d, damping="matrix")
    test = shaken(rng, structure, FREQ[::3], runs=2)
    whole = motion_of(structure)
    directions = []
    for size in ((n, n), (n, d), (d, d), (n, n), (n, n)):
        change = rng.normal(size=(4, *size))
        directions.append(change + change.swapaxes(1, 2) if size[0] == size[1] else change)
    scales = [np.abs(b).max() for b in numbers_of(*whole[:5])]
    p = ca.MX.sym("p", 4)
    moved = [
        block + scale * sum(p[i] * ca.DM(change[i]) for i in range(4))
        for block, change, scale in zip(whole[:5], directions, scales, strict=True)
    ]
    miss = relative_misfit(test, Motion(*moved, whole.rigid_body_dofs, whole.recovery), shift=shift)
    function = ca.Function("f", [p], [ca.densify(miss), ca.densify(ca.jacobian(miss, p))])
    J = np.asarray(function(np.zeros(4))[1])
    h = 1e-5
    for i in range(4):
        e = h * np.eye(4)[i]
        at = [np.asarray(function(k * e)[0]).ravel() for k in (-2, -1, 1, 2)]
        expected = (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * h)
        np.testing.assert_allclose(J[:, i], expected, atol=2e-7 * np.abs(expected).max())


def test_the_gradient_is_exact_also_through_lines_at_rest(random_structure):
    rng = np.random.default_rng(10)
    structure = random_structure(rng, 2, 1, damping="matrix")
    test = shaken(rng, structure, np.array([0.0, 3.0, 9.0]), runs=1)
    whole = motion_of(structure)
    p = ca.MX.sym("p")
    miss = relative_misfit(test, whole._replace(stiffness=whole.stiffness * (1 + p)))
    gradient = ca.Function("f", [p], [ca.gradient(ca.sumsqr(miss), p), ca.sumsqr(miss)])
    h = 1e-4
    values = [float(gradient(k * h)[1]) for k in (-2, -1, 1, 2)]
    expected = (values[0] - 8 * values[1] + 8 * values[2] - values[3]) / (12 * h)
    np.testing.assert_allclose(float(gradient(0.0)[0]), expected, rtol=1e-8)
