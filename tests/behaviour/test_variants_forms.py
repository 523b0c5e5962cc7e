"""Bundled problems whose matrices have a form of their own: each finds its truth, and claims what physics lets it."""

import dataclasses
import runpy

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid import catalogue
from sysid.assessment.determination import determine
from sysid.assessment.sensitivity import sensitivity

# Those that are determined, with the options of `problem`, and a seed for their noise.
DETERMINED = [
    ("diagonal_mass", {}, 0),
    ("known_masses", {}, 1),
    ("rayleigh_damping", {}, 1),
    ("rayleigh_damping", {"masses_known": True}, 2),
    ("physical_damping", {}, 1),
    ("spring_mass_chain", {}, 2),
    ("spring_mass_branched", {}, 2),
    ("equivalent_forces", {"force": True}, 2),
]
# What "auto" finds by the modal strategy, and what is not always found from its guess alone.
AUTO = ("diagonal_mass", "known_masses", "equivalent_forces")
NAMES = sorted({name for name, _, _ in DETERMINED})
MATRICES = ("mass", "stiffness", "damping")


def module(name):
    return runpy.run_path(str(catalogue.bundled_folder() / f"{name}.py"))


def build(name, **options):
    return module(name)["problem"](**options)


def blocks(structure):
    """M_SS, K_SS and C."""
    n = structure.n
    return [getattr(structure, name)[:n, :n] for name in MATRICES]


def distance(matrix, true):
    """Largest difference of entries, in units of the root of their two diagonals."""
    size = np.sqrt(np.diag(true))
    return np.max(np.abs(matrix - true) / np.outer(size, size))


@pytest.mark.parametrize("name", NAMES)
def test_a_variant_is_short_and_takes_no_records(name, tmp_path):
    assert len((catalogue.bundled_folder() / f"{name}.py").read_text(encoding="utf-8").splitlines()) < 60
    with pytest.raises(sysid.InputError, match=f"{name} is simulated"):
        build(name, data=tmp_path)


@pytest.mark.parametrize(
    ("name", "options"), [case[:2] for case in DETERMINED[2:]]
)  # those before by test_reference.py
def test_without_noise_it_is_the_truth(name, options, identified):
    result = identified(name, look=False, **options)
    problem = result.problem
    assert result.success and result.residual < 1e-8
    assert result.determined, result.undetermined
    for found, true in zip(blocks(result.structure), blocks(problem.reference), strict=True):
        assert distance(found, true) < 1e-6
    np.testing.assert_allclose(result.structure.rigid_body_mass, problem.reference.rigid_body_mass, rtol=1e-6)


@pytest.fixture(scope="module")
def noisy(identified_from_guess):
    """Give a function that identifies a problem with 1 % noise: once, however many tests look at its result.

    Most searches begin at the guess alone; without noise all begin elsewhere too.
    """
    known = {}

    def result(name, options, seed):
        key = (name, *options.items(), seed)
        if key not in known:
            problem = build(name, rng=seed, noise=0.01, **options)
            known[key] = identified_from_guess(problem, seed, *(["auto"] if name in AUTO else []))
        return known[key]

    return result


@pytest.mark.parametrize(("name", "options", "seed"), DETERMINED)
def test_with_noise_it_is_the_truth_within_its_standard_deviations(name, options, seed, noisy):
    result = noisy(name, options, seed)
    problem = result.problem
    assert result.success
    # The truth is one of the candidates.
    assert result.residual <= problem.measurement.residual(problem.reference)
    assert result.determined, result.undetermined
    claimed = [getattr(result.uncertainty, name) for name in MATRICES]
    for found, true, std in zip(blocks(result.structure), blocks(problem.reference), claimed, strict=True):
        # What is stated is known but for round-off; a claim of infinite error would hold anything.
        assert np.all(np.abs(found - true) <= 5 * std + 1e-9 * np.abs(true).max())
        assert np.all(std <= 0.1 * np.sqrt(np.outer(np.diag(true), np.diag(true))))


@pytest.mark.parametrize(
    ("name", "options", "seed"), [case for case in DETERMINED if case[0].startswith("spring_mass")]
)
def test_masses_springs_and_dampers_come_under_their_names(name, options, seed, noisy):
    own, result = module(name), noisy(name, options, seed)
    for variable, true in (("mass", "MASSES"), ("spring", "SPRINGS"), ("damper", "DAMPERS")):
        found, std = result.values[variable], result.uncertainty.variables[variable]
        assert np.all(np.abs(found - own[true][: found.size]) < 5 * std)
        assert np.all(std < 0.1 * found)


def test_a_chain_whose_total_nobody_knows_is_open_to_a_common_factor_and_to_nothing_else():
    own = module("spring_mass_chain")
    problem = dataclasses.replace(own["problem"](), constraints=(), healing={})
    x = np.concatenate([own["MASSES"], own["SPRINGS"], own["DAMPERS"]])
    assert problem.residual(x) < 1e-12
    known = sensitivity(problem.formulation, x)
    assert known.unseen.shape[1] == 1
    moved = known.unit * known.unseen[:, 0] / x
    np.testing.assert_allclose(moved / moved[0], 1.0, atol=1e-6)
    told = determine(problem.prepared, problem.structure(x), x)
    assert not told.determined
    # With the total, and nothing else, it is determined.
    whole = own["problem"]()
    assert determine(whole.prepared, whole.structure(x), x).determined


def test_a_branched_structure_with_no_mass_known_is_open_likewise():
    """A known mass and no more closes it: with the tuned mass an unknown too, a common factor stays open."""
    own = module("spring_mass_branched")
    T, n = own["T"], own["N"]
    m, k, c = (
        sysid.Variable(name, n, lower=0.1 * own[values], upper=10 * own[values])
        for name, values in (("mass", "MASSES"), ("spring", "SPRINGS"), ("damper", "DAMPERS"))
    )
    problem = sysid.Problem(
        own["problem"]().measurement, mass=ca.diag(m), stiffness=T.T @ ca.diag(k) @ T,
        damping=T[:, :n].T @ ca.diag(c) @ T[:, :n],
    )  # fmt: skip
    x = np.concatenate([own["MASSES"], own["SPRINGS"], own["DAMPERS"]])
    known = sensitivity(problem.formulation, x)
    assert known.unseen.shape[1] == 1
    moved = known.unit * known.unseen[:, 0] / x
    np.testing.assert_allclose(moved / moved[0], 1.0, atol=1e-6)


def test_a_diagonal_mass_without_its_total_gives_ratios_only():
    problem = build("diagonal_mass")
    open_ = dataclasses.replace(problem, mass=sysid.LumpedMass())
    result = sysid.identify(open_, rng=0)
    assert result.success and not result.determined
    found, true = (np.diag(blocks(s)[0]) for s in (result.structure, problem.reference))
    np.testing.assert_allclose(found / found.sum(), true / true.sum(), rtol=1e-6)


def test_known_masses_wrong_in_proportion_show_and_a_wrong_factor_passes_into_the_stiffness():
    problem = build("known_masses")
    M, K, C = blocks(problem.reference)
    doubled = sysid.identify(dataclasses.replace(problem, mass=2 * M), rng=0)
    assert doubled.residual < 1e-8
    assert distance(blocks(doubled.structure)[1], 2 * K) < 1e-6
    assert distance(blocks(doubled.structure)[2], 2 * C) < 1e-6
    skewed = sysid.identify(dataclasses.replace(problem, mass=M * np.diag([1.0, 1.0, 1.0, 1.2])), rng=0)
    assert skewed.residual > 1e-3
    assert not skewed.success


def test_rayleigh_factors_come_under_their_names(identified):
    own, result = module("rayleigh_damping"), identified("rayleigh_damping", look=False, masses_known=True)
    assert result.values["alpha"] == pytest.approx(own["ALPHA"], rel=1e-6)
    assert result.values["beta"] == pytest.approx(own["BETA"], rel=1e-6)


def test_the_physical_damping_of_the_variant_is_not_classical():
    """C M^-1 K is not symmetric (Caughey and O'Kelly 1965), and the best modal damping leaves thrice 1 % of noise."""
    problem = build("physical_damping")
    M, K, C = blocks(problem.reference)
    product = C @ np.linalg.solve(M, K)
    assert np.linalg.norm(product - product.T) > 0.1 * np.linalg.norm(product)
    modal = sysid.identify(sysid.Problem(problem.measurement, mass=M), rng=0)
    assert modal.residual > 0.03
    assert not modal.determined


@pytest.mark.parametrize("name", ["rayleigh_damping", "spring_mass_chain", "equivalent_forces"])
def test_healing_meets_the_constraint(name):
    formulation = build(name).formulation
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = rng.uniform(formulation.lower, formulation.upper)
        left = np.asarray(formulation.constraints.function(formulation.healing(x))).ravel()
        before = np.asarray(formulation.constraints.function(x)).ravel()
        assert np.all(np.abs(left) <= 1e-9 * np.abs(before).max())


class TestEquivalentForces:
    @staticmethod
    def invariants(structure):
        """M_SS^-1 K_SS, M_SS^-1 C and M_SS^-1 F, whatever the modal masses."""
        M, K, C = blocks(structure)
        n = structure.n
        F = M @ structure.rigid_body + structure.mass[:n, n:]
        return [np.linalg.solve(M, part) for part in (K, C, F)]

    def test_another_structure_of_the_same_trace_answers_identically(self):
        """Modal masses t_k: phi_k / sqrt(t_k), sqrt(t_k) gamma_k, here with two of three free; so it must be open."""
        problem = build("equivalent_forces")
        truth, n = problem.reference, problem.reference.n
        P, omega, zeta = np.linalg.inv(truth.normal_modes), 2 * np.pi * truth.natural_frequencies, truth.damping_ratios
        share = np.sum(P**2, axis=1)  # each mode's part of the trace
        change = np.cross(share, [1.0, 2.0, -1.0])  # keeps the trace
        t = 1 + 0.3 * change / np.abs(change).max()
        M, K = (P.T * t) @ P, (P.T * t * omega**2) @ P
        F, G = (P.T * t) @ truth.participation, truth.rigid_body
        M_S0 = F - M @ G
        mass = np.block([[M, M_S0], [M_S0.T, M_S0.T @ np.linalg.solve(M, M_S0)]])
        other = sysid.Structure(mass, np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]]), zeta, n_base=1)
        assert np.trace(M) == pytest.approx(np.trace(truth.mass[:n, :n]), rel=1e-12)
        assert distance(M, truth.mass[:n, :n]) > 0.05
        assert problem.measurement.residual(other) < 1e-12

    @pytest.mark.parametrize("noise", [0.0, 0.01])
    def test_what_is_determined_is_found_and_the_rest_is_said_to_be_open(self, noise):
        problem = build("equivalent_forces", rng=0, noise=noise)
        truth, n, d = problem.reference, problem.reference.n, problem.reference.n_base
        result = sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))
        s = result.structure
        assert result.success and not result.determined
        # w, zeta and residues of rank one are all that records see; the trace ties one unknown more.
        seen, free, count = (result.open_findings[0].numbers[name] for name in ("seen", "directions", "unknowns"))
        assert (seen, free, count) == (2 * n + n * (n + d - 1), n * (n + 1) + n * d + n - 1, n * (n + 1) + n * d + n)
        assert free - seen == n - 1
        assert np.trace(blocks(s)[0]) == pytest.approx(np.trace(blocks(truth)[0]), rel=1e-8)
        u = result.uncertainty
        for name in ("natural_frequencies", "damping_ratios"):
            assert np.all(np.abs(getattr(s, name) - getattr(truth, name)) <= 5 * getattr(u, name) + 1e-9)
        assert np.all(np.isnan(np.diag(u.mass)))
        for found, true in zip(self.invariants(s), self.invariants(truth), strict=True):
            assert np.linalg.norm(found - true) <= (1e-6 if noise == 0 else 0.05) * np.linalg.norm(true)
