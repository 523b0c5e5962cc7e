"""Structure against direct solves of the partitioned equations, closed forms and SciPy; its construction checks."""

import numpy as np
import pytest
import scipy.integrate
import scipy.linalg
import scipy.signal

import sysid
from sysid import InputError, Structure

SEEDS = range(4)
KINDS = ("ratios", "matrix")


def direct(structure, freq):
    """Absolute acceleration and base force per unit base acceleration, from the full partitioned equations.

    ``(-w² M + i w C + K) [u_S; u_0] = [0; f_0]`` with every damper between the structure and the moving base:
    ``C = [I, -G]' C_SS [I, -G]``, G the motion in which K stores no energy.
    """
    n, d = structure.n, structure.n_base
    M, K = structure.mass, structure.stiffness
    null = scipy.linalg.null_space(K / np.abs(K).max(), rcond=1e-11)
    assert null.shape[1] == d
    G = null[:n] @ np.linalg.inv(null[n:])
    T = np.hstack([np.eye(n), -G])
    C = T.T @ structure.damping @ T
    a, f = [], []
    for w in 2 * np.pi * np.asarray(freq):
        Z = -(w**2) * M + 1j * w * C + K
        u_0 = -np.eye(d) / w**2  # unit acceleration
        u_S = np.linalg.solve(Z[:n, :n], -Z[:n, n:] @ u_0)
        a.append(-(w**2) * u_S)
        f.append(Z[n:, :n] @ u_S + Z[n:, n:] @ u_0)
    return np.moveaxis(a, 0, -1), np.moveaxis(f, 0, -1)


def close(actual, expected, rtol):
    assert actual.shape == expected.shape
    assert np.linalg.norm(actual - expected) <= rtol * np.linalg.norm(expected)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("d", range(1, 7))
@pytest.mark.parametrize("kind", KINDS)
def test_responses_and_base_force_equal_a_direct_solve(random_structure, seed, d, kind):
    rng = np.random.default_rng([seed, d])
    s = random_structure(rng, n=int(rng.integers(2, 8)), d=d, damping=kind, base_mass=rng.choice([0.0, 1.0]))
    freq = rng.uniform(1, 80, 40)
    a, f = direct(s, freq)
    close(s.base_force(freq), f, 1e-10)
    close(s.transmissibility(freq), a, 1e-10)
    close(s.relative_acceleration(freq), a - s.rigid_body[:, :, None], 1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_ratios_and_their_physical_damping_matrix_answer_alike(random_structure, seed):
    s = random_structure(np.random.default_rng(seed), n=5, d=3)
    by_matrix = Structure(s.mass, s.stiffness, n_base=3, damping_matrix=s.damping)
    freq = np.linspace(1, 70, 50)
    close(by_matrix.relative_acceleration(freq), s.relative_acceleration(freq), 1e-10)
    close(by_matrix.base_force(freq), s.base_force(freq), 1e-10)
    np.testing.assert_allclose(by_matrix.damping_ratios, s.damping_ratios, rtol=1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_modes_solve_the_eigenproblem_and_are_mass_normalised(random_structure, seed):
    s = random_structure(np.random.default_rng(seed), n=6, d=2)
    n, phi = s.n, s.mode_shapes
    M, K = s.mass[:n, :n], s.stiffness[:n, :n]
    expected = np.sqrt(scipy.linalg.eigvalsh(K, M)) / (2 * np.pi)
    np.testing.assert_allclose(s.natural_frequencies, expected, rtol=1e-10)
    np.testing.assert_allclose(phi.T @ M @ phi, np.eye(n), atol=1e-11)
    np.testing.assert_allclose(K @ phi, M @ phi * (2 * np.pi * expected) ** 2, atol=1e-10 * np.abs(K).max())
    B = M @ s.rigid_body + s.mass[:n, n:]
    np.testing.assert_allclose(s.participation, phi.T @ B, atol=1e-11)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_largest_entry_of_each_mode_is_positive(random_structure, seed):
    s = random_structure(np.random.default_rng(seed), n=7, d=1)
    largest = s.mode_shapes[np.argmax(np.abs(s.mode_shapes), axis=0), np.arange(7)]
    assert np.all(largest > 0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", SEEDS)
def test_at_low_frequency_it_moves_and_weighs_as_a_rigid_body(random_structure, seed, kind):
    s = random_structure(np.random.default_rng(seed), n=4, d=6, damping=kind)
    freq = [0.0, 1e-6]
    for line in range(2):
        np.testing.assert_allclose(s.transmissibility(freq)[..., line], s.rigid_body, atol=1e-9)
        np.testing.assert_allclose(s.base_force(freq)[..., line], s.rigid_body_mass, rtol=1e-9, atol=1e-9)
    rigid = np.vstack([s.rigid_body, np.eye(6)])
    np.testing.assert_allclose(s.rigid_body_mass, rigid.T @ s.mass @ rigid, rtol=1e-11, atol=1e-11)


@pytest.mark.parametrize("seed", SEEDS)
def test_effective_masses_and_the_schur_remainder_make_the_rigid_body_mass(random_structure, seed):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=5, d=int(rng.integers(1, 7)))
    n, M = s.n, s.mass
    schur = M[n:, n:] - M[n:, :n] @ np.linalg.solve(M[:n, :n], M[:n, n:])
    np.testing.assert_allclose(s.effective_masses.sum(axis=0) + schur, s.rigid_body_mass, rtol=1e-10, atol=1e-10)
    for k in range(n):
        np.testing.assert_allclose(s.effective_masses[k], np.outer(s.participation[k], s.participation[k]), rtol=1e-14)


@pytest.mark.parametrize("seed", SEEDS)
def test_physical_damping_is_diagonal_in_the_modes(random_structure, seed):
    s = random_structure(np.random.default_rng(seed), n=5, d=2)
    omega, inverse = 2 * np.pi * s.natural_frequencies, np.linalg.inv(s.mode_shapes)
    expected = inverse.T @ np.diag(2 * s.damping_ratios * omega) @ inverse  # eq. 33
    np.testing.assert_allclose(s.damping, expected, atol=1e-10 * np.abs(expected).max())
    np.testing.assert_allclose(s.damping, s.damping.T, atol=1e-14 * np.abs(expected).max())


@pytest.mark.parametrize("seed", SEEDS)
def test_ratios_of_a_damping_matrix_are_its_diagonal_in_the_modes(random_structure, seed):
    s = random_structure(np.random.default_rng(seed), n=5, d=2, damping="matrix")
    modal = s.mode_shapes.T @ s.damping @ s.mode_shapes
    assert np.abs(modal - np.diag(np.diag(modal))).max() > 0.01 * np.diag(modal).max()  # not a normal-mode case
    np.testing.assert_allclose(s.damping_ratios, np.diag(modal) / (4 * np.pi * s.natural_frequencies), rtol=1e-10)


def test_one_mass_on_a_spring_has_the_textbook_transmissibility():
    m, k, zeta = 2.5, 4000.0, 0.03
    s = Structure(np.diag([m, 0.7]), k * np.array([[1, -1], [-1, 1]]), [zeta], n_base=1)
    wn = np.sqrt(k / m)
    r = np.linspace(0.01, 5, 200)
    T = (1 + 2j * zeta * r) / (1 - r**2 + 2j * zeta * r)
    np.testing.assert_allclose(s.transmissibility(r * wn / (2 * np.pi))[0, 0], T, rtol=1e-12)
    np.testing.assert_allclose(s.base_force(r * wn / (2 * np.pi))[0, 0], m * T + 0.7, rtol=1e-12)
    np.testing.assert_allclose(s.damping, [[2 * zeta * m * wn]], rtol=1e-12)
    np.testing.assert_allclose(s.natural_frequencies, wn / (2 * np.pi), rtol=1e-12)


def test_a_uniform_chain_has_its_closed_form_frequencies():
    n, m, k = 9, 3.0, 5e4
    K = k * (2 * np.eye(n + 1) - np.eye(n + 1, k=1) - np.eye(n + 1, k=-1))
    K[-1, -1] = k  # mass 0 is next to the base, the last row, the top is free
    K[-1, :], K[:, -1] = 0, 0
    K[n - 1, n - 1] = k
    K[0, -1] = K[-1, 0] = -k
    K[-1, -1] = k
    s = Structure(np.diag([*np.full(n, m), 0.0]), K, np.full(n, 0.01), n_base=1)
    j = np.arange(1, n + 1)
    expected = 2 * np.sqrt(k / m) * np.sin((2 * j - 1) * np.pi / (2 * (2 * n + 1))) / (2 * np.pi)
    np.testing.assert_allclose(s.natural_frequencies, expected, rtol=1e-12)
    np.testing.assert_allclose(s.rigid_body, np.ones((n, 1)), rtol=1e-12)
    np.testing.assert_allclose(s.rigid_body_mass, [[n * m]], rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", SEEDS)
def test_state_space_has_the_transmissibility_as_its_frequency_response(random_structure, seed, kind):
    s = random_structure(np.random.default_rng(seed), n=4, d=3, damping=kind)
    system = s.to_state_space()
    freq = np.linspace(0.5, 80, 60)
    H = [system.C @ np.linalg.solve(2j * np.pi * f * np.eye(8) - system.A, system.B) + system.D for f in freq]
    close(np.moveaxis(H, 0, -1), s.transmissibility(freq), 1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_scipy_freqresp_of_the_state_space_is_the_transmissibility(random_structure, kind):
    s = random_structure(np.random.default_rng(1), n=2, d=2, damping=kind, frequencies=[4.0, 9.0])
    system, freq = s.to_state_space(), np.linspace(1, 15, 40)
    for i in range(2):
        for j in range(2):
            single = scipy.signal.StateSpace(system.A, system.B[:, [j]], system.C[[i]], system.D[[i]][:, [j]])
            _, H = scipy.signal.freqresp(single, 2 * np.pi * freq)
            # freqresp goes through polynomials: eight digits are left of sixteen.
            np.testing.assert_allclose(H, s.transmissibility(freq)[i, j], rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("kind", KINDS)
def test_lsim_settles_to_the_transmissibility_of_a_sine(random_structure, kind):
    s = random_structure(np.random.default_rng(2), n=2, d=1, damping=kind, frequencies=[4.0, 7.0], ratios=[0.1, 0.08])
    if kind == "matrix":
        s = Structure(s.mass, s.stiffness, n_base=1, damping_matrix=5 * s.damping)
    rate, f = 2000.0, 5.0
    t = np.arange(0, 12, 1 / rate)
    _, y, _ = scipy.signal.lsim(s.to_state_space(), np.cos(2 * np.pi * f * t), t)
    last = t >= 10  # ten whole periods
    amplitude = 2 * np.mean(y[last] * np.exp(-2j * np.pi * f * t[last])[:, None], axis=0)
    # A straight line between samples follows the sine to (w dt)² / 12 = 2e-5.
    np.testing.assert_allclose(amplitude, s.transmissibility([f])[:, 0, 0], rtol=1e-4)


@pytest.mark.parametrize("seed", SEEDS)
def test_recovery_takes_every_response_to_the_sensors(random_structure, seed):
    rng = np.random.default_rng(seed)
    full = random_structure(rng, n=6, d=2)
    R, G = rng.normal(size=(3, 6)), rng.normal(size=(3, 2))
    s = Structure(full.mass, full.stiffness, full.damping_ratios, n_base=2, recovery=R, rigid_body=G)
    freq = np.linspace(1, 70, 30)
    a = np.einsum("sn,ndf->sdf", R, full.relative_acceleration(freq))
    close(s.relative_acceleration(freq), a, 1e-12)
    close(s.transmissibility(freq), a + G[:, :, None], 1e-12)
    close(s.base_force(freq), full.base_force(freq), 1e-12)
    np.testing.assert_allclose(s.mode_shapes, R @ full.mode_shapes, rtol=1e-12)
    np.testing.assert_array_equal(s.rigid_body, G)
    assert s.n_sensors == 3
    system = s.to_state_space()
    H = [system.C @ np.linalg.solve(2j * np.pi * f * np.eye(12) - system.A, system.B) + system.D for f in freq]
    close(np.moveaxis(H, 0, -1), s.transmissibility(freq), 1e-9)


def test_coordinates_that_are_relative_already_need_geometry_from_outside(random_structure):
    """Fixed-base modal coordinates: K_S0 = 0, coupling by participation; the same structure at its sensors."""
    physical = random_structure(np.random.default_rng(3), n=5, d=2)
    gamma, omega = physical.participation, 2 * np.pi * physical.natural_frequencies
    M = np.block([[np.eye(5), gamma], [gamma.T, physical.rigid_body_mass]])
    K = np.diag([*omega**2, 0, 0])
    s = Structure(
        M, K, physical.damping_ratios, n_base=2, recovery=physical.mode_shapes, rigid_body=physical.rigid_body
    )
    freq = np.linspace(1, 70, 30)
    close(s.transmissibility(freq), physical.transmissibility(freq), 1e-10)
    close(s.base_force(freq), physical.base_force(freq), 1e-10)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_stated_geometry_that_agrees_is_accepted(random_structure, seed):
    s = random_structure(np.random.default_rng(seed), n=4, d=2)
    again = Structure(s.mass, s.stiffness, s.damping_ratios, n_base=2, rigid_body=s.rigid_body)
    np.testing.assert_array_equal(again.rigid_body, s.rigid_body)


def test_a_massless_base_is_accepted(random_blocks):
    M, K, G = random_blocks(np.random.default_rng(0), 4, 2)
    M[:, 4:], M[4:, :] = 0, 0
    s = Structure(M, K, np.full(4, 0.01), n_base=2)
    np.testing.assert_allclose(s.rigid_body_mass, G.T @ M[:4, :4] @ G, rtol=1e-10)


@pytest.mark.parametrize("seed", range(20))
def test_base_mass_on_the_boundary_of_semidefinite_is_accepted(random_blocks, seed):
    M, K, _ = random_blocks(np.random.default_rng(seed), 4, 3, base_mass=0.0)
    s = Structure(M, K, np.full(4, 0.01), n_base=3)
    np.testing.assert_allclose(s.effective_masses.sum(axis=0), s.rigid_body_mass, rtol=1e-9, atol=1e-9)


def test_matrices_are_copies_of_what_was_given(random_blocks):
    M, K, _ = random_blocks(np.random.default_rng(0), 3, 1)
    s = Structure(M, K, np.full(3, 0.01), n_base=1)
    M[0, 0] = 1e9
    assert s.mass[0, 0] != 1e9


class TestConstructionChecks:
    @pytest.fixture
    def good(self, random_blocks):
        M, K, _ = random_blocks(np.random.default_rng(5), 3, 2)
        return {"mass": M, "stiffness": K, "damping_ratios": np.full(3, 0.02), "n_base": 2}

    @staticmethod
    def refuse(good, match, **changes):
        with pytest.raises(InputError, match=match):
            Structure(**(good | changes))

    @pytest.mark.parametrize("name", ["mass", "stiffness"])
    def test_asymmetry(self, good, name):
        matrix = good[name].copy()
        matrix[0, 1] *= 1.001
        self.refuse(good, f"{name} is not symmetric.*\\[0, 1\\]|{name} is not symmetric.*\\[1, 0\\]", **{name: matrix})

    def test_asymmetric_damping(self, good):
        C = np.diag([1.0, 2.0, 3.0])
        C[0, 1] = 0.1
        self.refuse(good, "damping_matrix is not symmetric", damping_ratios=None, damping_matrix=C)

    @pytest.mark.parametrize("name", ["mass", "stiffness"])
    def test_an_indefinite_block_of_the_structure(self, good, name, random_orthogonal):
        matrix = good[name].copy()
        q = random_orthogonal(np.random.default_rng(0), 3)
        matrix[:3, :3] = np.abs(matrix[:3, :3]).max() * (q * [-0.2, 1, 2]) @ q.T
        matrix = (matrix + matrix.T) / 2
        self.refuse(good, f"block of {name}.*not positive definite", **{name: matrix})

    @pytest.mark.parametrize("name", ["mass", "stiffness"])
    @pytest.mark.parametrize("seed", range(8))
    def test_a_singular_block_of_the_structure(self, random_blocks, random_orthogonal, name, seed):
        """A mechanism, or a sensor without mass: singular up to round-off, of either sign."""
        rng = np.random.default_rng(seed)
        M, K, G = random_blocks(rng, 5, 1)
        half = random_orthogonal(rng, 5)[:, :4] * np.sqrt(rng.uniform(1, 4, 4))
        block = half @ half.T
        if name == "mass":
            M[:5, :5] = block
            M[:5, 5:], M[5:, :5] = 0, 0
        else:
            K = np.block([[block, -block @ G], [-(block @ G).T, G.T @ block @ G]])
        with pytest.raises(InputError, match=f"block of {name}.*not positive definite"):
            Structure((M + M.T) / 2, (K + K.T) / 2, np.full(5, 0.01), n_base=1)

    def test_a_mass_that_is_not_semidefinite(self, good):
        M = good["mass"].copy()
        schur = M[3:, 3:] - M[3:, :3] @ np.linalg.solve(M[:3, :3], M[:3, 3:])
        M[3:, 3:] -= 1.05 * schur
        self.refuse(good, "mass is not positive semidefinite", mass=M)

    @pytest.mark.parametrize("factor", [0.99, 1.01])
    def test_a_stiffness_that_holds_the_base_to_the_ground(self, good, factor):
        K = good["stiffness"].copy()
        K[3:, 3:] *= factor
        self.refuse(good, r"null space \[G; I\]", stiffness=K)

    def test_a_massless_sensor(self, good):
        M = good["mass"].copy()
        M[1, :], M[:, 1] = 0, 0
        self.refuse(good, "mass.*diagonal entry 1", mass=M)

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    @pytest.mark.parametrize("name", ["mass", "stiffness", "damping_ratios"])
    def test_samples_that_are_not_finite(self, good, name, bad):
        value = good[name].copy()
        value.flat[0] = bad
        self.refuse(good, f"{name} holds NaN or infinite", **{name: value})

    def test_shapes(self, good):
        self.refuse(good, "mass has shape", mass=np.ones((5, 4)))
        self.refuse(good, "stiffness has shape", stiffness=np.ones(5))
        self.refuse(good, r"mass is \(4, 4\) but stiffness is \(5, 5\)", mass=np.eye(4))
        self.refuse(good, r"damping_ratios has shape \(2,\)", damping_ratios=[0.1, 0.1])
        self.refuse(good, "damping_matrix has shape", damping_ratios=None, damping_matrix=np.eye(5))
        self.refuse(good, "n_base is 0", n_base=0)
        self.refuse(good, "n_base = 5", n_base=5)
        self.refuse(good, "recovery has shape", recovery=np.ones((2, 4)), rigid_body=np.ones((2, 2)))
        self.refuse(good, "rigid_body has shape", rigid_body=np.ones((2, 2)))
        self.refuse(good, "rigid_body has shape", recovery=np.ones((2, 3)), rigid_body=np.ones((3, 2)))
        self.refuse(good, "mass is not an array of real numbers: 'heavy'", mass="heavy")

    def test_complex_matrices_are_refused(self, good):
        self.refuse(good, "real", stiffness=good["stiffness"].astype(complex) * (1 + 0.01j))

    def test_both_kinds_of_damping_or_neither(self, good):
        self.refuse(good, "exactly one", damping_matrix=np.eye(3))
        self.refuse(good, "exactly one", damping_ratios=None)

    def test_damping_that_feeds_energy_in(self, good):
        self.refuse(good, "damping ratio -0.01 is negative", damping_ratios=[0.01, -0.01, 0.02])
        self.refuse(good, "damping_matrix", damping_ratios=None, damping_matrix=np.diag([1.0, -1.0, 1.0]))

    def test_a_geometry_that_disagrees_with_the_stiffness(self, good):
        G = Structure(**good).rigid_body
        self.refuse(good, "rigid_body differs", rigid_body=-G)

    def test_without_geometry_sensors_move_with_their_degrees_of_freedom(self, good):
        recovery = np.array([[1.0, 0.0, 0.0], [0.5, 0.5, 0.0]])
        structure = sysid.Structure(**{**good, "recovery": recovery})
        np.testing.assert_allclose(structure.rigid_body, recovery @ structure.rigid_body_dofs)

    def test_number_of_sensors(self, good):
        self.refuse(good, "1 sensors are described", sensors=[sysid.Sensor("a", (0, 0, 0), "x")])

    @pytest.mark.parametrize("freq", [[-1.0], [np.nan], [], [[1.0, 2.0]], "x"])
    def test_frequencies_at_which_a_response_is_asked(self, good, freq):
        with pytest.raises(InputError, match="freq"):
            Structure(**good).transmissibility(freq)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", KINDS)
def test_the_craig_bampton_form_answers_as_the_structure_does(random_structure, seed, kind):
    rng = np.random.default_rng(seed)
    s = random_structure(rng, n=4, d=3, damping=kind)
    recovery = rng.normal(size=(6, 4))
    C = {"damping_ratios": s.damping_ratios} if s.modal_damping else {"damping_matrix": s.damping}
    s = Structure(s.mass, s.stiffness, n_base=3, recovery=recovery, rigid_body=recovery @ s.rigid_body, **C)
    form, n = s.to_craig_bampton(), s.n
    freq = rng.uniform(1, 80, 10)
    a, f = [], []
    for w in 2 * np.pi * freq:
        # Accelerations z'' for unit base accelerations; the first n rows of the equation of motion have no load.
        Z = form.mass + form.damping / (1j * w) - form.stiffness / w**2
        z = np.vstack([np.linalg.solve(Z[:n, :n], -Z[:n, n:]), np.eye(3)])
        a.append(form.recovery @ z)
        f.append((Z @ z)[n:])
    close(np.moveaxis(a, 0, -1), s.transmissibility(freq), 1e-9)
    close(np.moveaxis(f, 0, -1), s.base_force(freq), 1e-9)
    close(form.mass[n:, n:], s.rigid_body_mass, 1e-12)


def test_mode_shapes_at_the_sensors_are_recovered_from_those_at_the_degrees_of_freedom(random_structure):
    rng = np.random.default_rng(0)
    s = random_structure(rng, n=4, d=2)
    recovery = rng.normal(size=(3, 4))
    t = Structure(
        s.mass, s.stiffness, s.damping_ratios, n_base=2, recovery=recovery, rigid_body=recovery @ s.rigid_body
    )
    close(t.mode_shapes, recovery @ t.normal_modes, 1e-14)
    close(t.normal_modes.T @ s.mass[:4, :4] @ t.normal_modes, np.eye(4), 1e-12)
    close(t.rigid_body_dofs, s.rigid_body, 1e-12)
