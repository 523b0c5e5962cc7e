"""The modal-mass cone: its members, and the verdict on stated models."""

import dataclasses
import re

import numpy as np
import pytest

import sysid
from sysid import FullMass, KnownMass, LumpedMass, Measurement, Problem, SpectralStiffness, Structure
from sysid.assessment.determination import determine

FREQ = np.linspace(1, 70, 60)


def member(structure, t):
    """The structure of the cone with modal masses t (method of the linear formulas; M_rb is not kept)."""
    n, G = structure.n, structure.rigid_body
    P, w2 = np.linalg.inv(structure.mode_shapes), (2 * np.pi * structure.natural_frequencies) ** 2
    M_SS, K_SS = (P.T * t) @ P, (P.T * (t * w2)) @ P
    M_S0 = (P.T * t) @ (structure.participation - P @ G)
    M_00 = M_S0.T @ np.linalg.solve(M_SS, M_S0) + np.eye(G.shape[1])
    M = np.block([[M_SS, M_S0], [M_S0.T, M_00]])
    K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
    assert M_SS.shape == (n, n)
    return Structure((M + M.T) / 2, (K + K.T) / 2, structure.damping_ratios, n_base=G.shape[1])


def is_lumped(structure):
    """Diagonal over the sensors, and not coupled to the base."""
    n, M = structure.n, structure.mass
    off = np.hstack([M[:n, :n] - np.diag(np.diag(M)[:n]), M[:n, n:]])
    return bool(np.abs(off).max() < 1e-9 * np.diag(M)[:n].max())


def problem_of(structure, mass, *, force=False, stiffness=None, test=None):
    test = sysid.simulate(structure, FREQ, force=force) if test is None else test
    return Problem(test, mass=mass, stiffness=stiffness or SpectralStiffness(structure.natural_frequencies))


@pytest.fixture
def full(random_structure):
    return random_structure(np.random.default_rng(0), n=4, d=2)


@pytest.fixture
def lumped(random_case):
    return random_case(np.random.default_rng(0), "lumped", n=4, d=2)[0]


@pytest.mark.parametrize("seed", range(5))
def test_members_of_the_cone_answer_identically_and_weigh_differently(random_structure, seed):
    rng = np.random.default_rng(seed)
    one = random_structure(rng, n=5, d=int(rng.integers(1, 4)))
    other = member(one, rng.uniform(0.2, 5, 5))
    a, b = one.transmissibility(FREQ), other.transmissibility(FREQ)
    assert np.linalg.norm(a - b) < 1e-10 * np.linalg.norm(a)
    assert np.linalg.norm(one.mass[:5, :5] - other.mass[:5, :5]) > 0.1 * np.linalg.norm(one.mass[:5, :5])
    f, g = one.base_force(FREQ), other.base_force(FREQ)
    assert np.linalg.norm(f - g) > 1e-3 * np.linalg.norm(f)  # the force tells them apart
    verdict = determine(problem_of(one, FullMass(1.0)).prepared, one, None)
    assert not verdict.determined


class TestVerdict:
    def check(self, verdict, determined, *, says=()):
        assert verdict.determined is determined
        assert bool(verdict.undetermined) is not determined
        assert bool(verdict.closed_by) or not determined
        for words in [says] if isinstance(says, str) else says:
            assert any(words in sentence for sentence in (*verdict.closed_by, *verdict.undetermined)), words

    @pytest.mark.parametrize("healing", ["trace", "rigid_body"])
    def test_a_full_mass_needs_the_force(self, full, healing):
        """A total with M_00 free bounds the modal masses and fixes none."""
        for total in (None, 50.0):
            verdict = determine(problem_of(full, FullMass(total, healing=healing)).prepared, full, None)
            self.check(verdict, False, says="all modal masses are open")
            forced = problem_of(full, FullMass(total, healing=healing), force=True)
            self.check(determine(forced.prepared, full, None), True, says="base force weighs")

    def test_without_any_number_of_mass_it_is_said(self, full):
        self.check(determine(problem_of(full, FullMass()).prepared, full, None), False, says="normalised to 1 kg")
        stated = determine(problem_of(full, FullMass(50.0)).prepared, full, None)
        assert not any("normalised" in sentence for sentence in stated.undetermined)

    def test_a_lumped_mass_needs_its_total(self, lumped):
        with_total = [np.diag(lumped.mass)[:4][i::2].sum() for i in range(2)]
        self.check(
            determine(problem_of(lumped, LumpedMass(with_total)).prepared, lumped, None), True, says="total given"
        )
        self.check(determine(problem_of(lumped, LumpedMass()).prepared, lumped, None), False, says="normalised to 1 kg")
        self.check(determine(problem_of(lumped, LumpedMass(), force=True).prepared, lumped, None), True)

    @pytest.mark.parametrize("seed", range(3))
    def test_without_its_total_a_coupled_lumped_mass_leaves_one_scale(self, random_case, seed):
        """Modal masses in one proportion keep the mass lumped, and no others do."""
        truth, _ = random_case(np.random.default_rng(seed), "lumped", n=5, d=1)
        verdict = determine(problem_of(truth, LumpedMass()).prepared, truth, None)
        self.check(verdict, False, says="mass, stiffness and damping are known up to one common factor")
        assert is_lumped(member(truth, np.full(5, 3.0)))
        assert not is_lumped(member(truth, np.array([3.0, 3.0, 3.0, 3.0, 2.9])))

    def test_uncoupled_directions_leave_a_scale_each(self):
        """x and y shake independently: lumped mass without a total leaves two scales, and one total closes one."""
        k = np.array([3.0, 2.0, 5.0, 4.0]) * 1e4
        K_SS = np.zeros((4, 4))
        for x, y in ((0, 2), (1, 3)):
            K_SS[np.ix_([x, y], [x, y])] = [[k[x] + k[y], -k[y]], [-k[y], k[y]]]
        G = np.tile(np.eye(2), (2, 1))
        M = np.diag([2.0, 1, 1, 3, 0, 0])
        K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
        truth = Structure(M, K, np.full(4, 0.01), n_base=2)
        self.check(
            determine(problem_of(truth, LumpedMass()).prepared, truth, None), False, says="all modal masses are open"
        )
        along_x = np.abs(truth.participation[:, 0]) > np.abs(truth.participation[:, 1])
        other = member(truth, np.where(along_x, 3.0, 0.5))
        assert is_lumped(other)
        a, b = truth.transmissibility(FREQ), other.transmissibility(FREQ)
        assert np.linalg.norm(a - b) < 1e-10 * np.linalg.norm(a)
        self.check(determine(problem_of(truth, LumpedMass([3.0, 4.0])).prepared, truth, None), True)

    def test_a_known_mass_determines_all(self, full):
        self.check(
            determine(problem_of(full, KnownMass(full.mass)).prepared, full, None), True, says="mass matrix is known"
        )

    def test_a_mode_that_the_base_does_not_move_stays_open(self):
        """A symmetric pair on one base direction: its antisymmetric mode has no participation, force or not."""
        k, c = 1e4, 3e3
        K_SS = np.array([[k + c, -c], [-c, k + c]])
        G = np.ones((2, 1))
        K = np.block([[K_SS, -K_SS @ G], [-(K_SS @ G).T, G.T @ K_SS @ G]])
        truth = Structure(np.diag([1.0, 1.0, 0.5]), K, [0.01, 0.02], n_base=1)
        assert abs(truth.participation[1, 0]) < 1e-12
        for force in (False, True):
            verdict = determine(problem_of(truth, FullMass(3.0), force=force).prepared, truth, None)
            self.check(verdict, False, says=["mode 2", "is not moved by the base"])
        self.check(verdict, False, says="the modal mass of mode 2 (20.13 Hz) is open")  # the force weighs mode 1 alone

    @pytest.mark.parametrize("force", [False, True])
    def test_one_run_of_a_fixed_direction_leaves_the_other_open(self, full, force):
        unit = sysid.simulate(full, FREQ, force=True)
        direction = np.array([0.6, 0.8])
        mix = lambda record: np.einsum("r,rcf->cf", direction, record)[None]  # noqa: E731
        test = Measurement(
            FREQ, mix(unit.base), mix(unit.response), rigid_body=full.rigid_body,
            force=mix(unit.force) if force else None,
        )  # fmt: skip
        verdict = determine(problem_of(full, KnownMass(full.mass), test=test).prepared, full, None)
        self.check(verdict, False, says="only 1 of 2 independent directions")

    def test_one_run_whose_direction_turns_is_enough(self, full):
        unit = sysid.simulate(full, FREQ, force=True)
        turning = np.stack([np.cos(FREQ / 10), np.sin(FREQ / 10)])
        mix = lambda record: np.einsum("rf,rcf->cf", turning, record)[None]  # noqa: E731
        test = Measurement(FREQ, mix(unit.base), mix(unit.response), rigid_body=full.rigid_body, force=mix(unit.force))
        self.check(determine(problem_of(full, FullMass(), test=test).prepared, full, None), True)

    @pytest.mark.parametrize("seed", range(3))
    def test_a_chain_with_lumped_masses(self, random_case, seed):
        truth, problem = random_case(np.random.default_rng(seed), "lumped", "chain", n=4)
        verdict = determine(problem.prepared, truth, None)
        self.check(verdict, True, says="chain")
        open_total = dataclasses.replace(problem, mass=LumpedMass())
        self.check(determine(open_total.prepared, truth, None), False)

    @pytest.mark.parametrize("seed", range(3))
    def test_a_chain_alone_has_no_unit_of_mass(self, random_case, seed):
        truth, problem = random_case(np.random.default_rng(seed), "trace", "chain", n=4, d=1)
        self.check(determine(problem.prepared, truth, None), False)

    def test_repeated_poles_need_as_many_force_directions(self, random_blocks):
        """One base direction and a pole of multiplicity two: only the sum of its residues is seen, so that a rotated
        pair of modes has a member that the base does not move. Two structures with the same force and responses."""
        rng = np.random.default_rng(0)
        M, K, _ = random_blocks(rng, 3, 1, frequencies=[10.0, 10.0, 25.0])
        truth = Structure(M, K, [0.02, 0.02, 0.01], n_base=1)
        gamma = truth.participation[:2, 0]
        turn = np.array([[gamma[0], gamma[1]], [-gamma[1], gamma[0]]]) / np.hypot(*gamma)
        phi, push = truth.mode_shapes.copy(), truth.participation.copy()
        phi[:, :2], push[:2] = phi[:, :2] @ turn.T, turn @ push[:2]
        assert abs(push[1, 0]) < 1e-12 * abs(push[0, 0])
        phi[:, 1] *= 3  # the mode that nothing moves may weigh anything
        P, G = np.linalg.inv(phi), truth.rigid_body
        M_SS, K_SS = P.T @ P, (P.T * (2 * np.pi * truth.natural_frequencies) ** 2) @ P
        M_S0 = P.T @ push - M_SS @ G
        M_00 = truth.rigid_body_mass - G.T @ M_SS @ G - G.T @ M_S0 - M_S0.T @ G
        K_S0 = -K_SS @ G
        other = Structure(
            np.block([[M_SS, M_S0], [M_S0.T, M_00]]), np.block([[K_SS, K_S0], [K_S0.T, -G.T @ K_S0]]),
            truth.damping_ratios, n_base=1,
        )  # fmt: skip
        for answer in ("transmissibility", "base_force"):
            a, b = getattr(truth, answer)(FREQ), getattr(other, answer)(FREQ)
            assert np.linalg.norm(a - b) < 1e-9 * np.linalg.norm(a)
        assert np.linalg.norm(M_SS - truth.mass[:3, :3]) > 0.1 * np.linalg.norm(M_SS)
        assert not determine(problem_of(truth, FullMass(), force=True).prepared, truth, None).determined

    @pytest.mark.parametrize(("d", "multiplicity", "determined"), [(2, 2, True), (3, 3, True), (2, 3, False)])
    def test_a_force_in_as_many_directions_as_a_pole_repeats_weighs_its_modes(
        self, random_blocks, d, multiplicity, determined
    ):
        """The force gives d (d + 1) / 2 numbers a pole; m modes at one pole have m (m + 1) / 2 of them to know."""
        for seed in range(3):
            frequencies = [10.0] * multiplicity + [25.0, 40.0]
            M, K, _ = random_blocks(np.random.default_rng(seed), len(frequencies), d, frequencies=frequencies)
            truth = Structure(M, K, [0.02] * multiplicity + [0.01, 0.015], n_base=d)
            verdict = determine(problem_of(truth, FullMass(), force=True).prepared, truth, None)
            self.check(verdict, determined, says="base force weighs" if determined else "mode 2")
            self.check(determine(problem_of(truth, FullMass(20.0)).prepared, truth, None), False)


def test_a_mode_too_faint_for_the_force_is_weighed_by_a_lumped_mass():
    """Of a lumped mass one modal mass gives all others, so the mode that the force shows is enough."""
    mass, springs, ratios = np.array([1800.0, 600.0]), np.array([1e6, 4e6]), np.array([0.01, 0.1])
    K = np.array(
        [[springs.sum(), -springs[1], -springs[0]], [-springs[1], springs[1], 0], [-springs[0], 0, springs[0]]]
    )
    truth = Structure(np.diag([*mass, 0.0]), K, ratios, n_base=1)
    carried = truth.effective_masses[1, 0, 0] / mass.sum()
    assert carried < 0.01
    freq = np.linspace(0.4, 1.6, 80) * truth.natural_frequencies[:, None]
    test = sysid.simulate(truth, np.unique(freq.ravel()), noise=0.01, force=True, rng=3)
    full, lumped = (sysid.identify(Problem(test, mass=model), rng=0) for model in (FullMass(), LumpedMass()))
    assert not full.determined and any("mode 2" in sentence for sentence in full.undetermined)
    assert lumped.determined, lumped.undetermined
    (weighed,) = [sentence for sentence in lumped.closed_by if "base force" in sentence]
    assert re.findall(r"\d+", weighed) == ["1", "2"]  # of so many modes
    off = np.diag(lumped.structure.mass)[:2] - mass
    assert np.all(np.abs(off) < 5 * np.diag(lumped.uncertainty.mass))
    assert np.all(np.diag(lumped.uncertainty.mass) < 0.05 * mass)


def test_deviations_that_are_all_zero_tell_no_noise():
    freq = np.linspace(1.0, 20.0, 120)
    K = (2 * np.pi * 8.0) ** 2 * 10 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    truth = sysid.Structure(np.diag([10.0, 5.0]), K, [0.02], n_base=1)
    test = sysid.simulate(truth, freq, force=True, noise=0.001, rng=0)
    given = dataclasses.replace(test, response_std=np.full(test.response.shape, 1e-3), force_std=0 * test.force.real)
    result = sysid.identify(sysid.Problem(given, mass=sysid.FullMass()), rng=0)
    np.testing.assert_allclose(result.structure.natural_frequencies, truth.natural_frequencies, rtol=1e-3)
