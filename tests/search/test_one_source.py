"""The swarm's objective and IPOPT's rows come from the same expressions: what changes one changes the other alike."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.models import mass as mass_models
from sysid.problem.terms import ModeSymbols
from sysid.search.swarm_objective import SwarmObjective
from tests.models.own_models import CirculantStiffness, ComponentMass

N, D, COUNT = 3, 2, 50
G = np.array([[1.0, 0.0], [0.0, 1.0], [0.6, 0.8]])
ALONG = np.ones((N, 1))  # a chain or a ring stands in one direction
FREQ = np.linspace(1.0, 25.0, 30)


def truth(rigid_body):
    """Modes of 3 to 16 Hz, coupled to a base of mass."""
    rng = np.random.default_rng(2)
    n, d = rigid_body.shape
    factor = np.tril(rng.normal(size=(n + d, n + d))) + 3 * np.eye(n + d)
    half = factor[:n, :n] @ np.linalg.qr(rng.normal(size=(n, n)))[0] * (2 * np.pi * np.array([3.0, 9.0, 16.0]))
    K = half @ half.T
    K_S0 = -K @ rigid_body
    whole = np.block([[K, K_S0], [K_S0.T, -rigid_body.T @ K_S0]])
    return sysid.Structure(factor @ factor.T, whole, np.array([0.01, 0.02, 0.03]), n_base=d)


def make(given):
    """A full mass, a stiffness by its spectrum and modal damping, but for what is given."""
    parts = {
        "rigid_body": G, "mass": sysid.FullMass(30.0, healing="rigid_body"),
        "stiffness": sysid.SpectralStiffness([3.0, 9.0, 16.0]), "damping": sysid.ModalDamping(0.005, 0.05),
    } | given  # fmt: skip
    return sysid.Problem(sysid.simulate(truth(parts.pop("rigid_body")), FREQ, force=True), **parts)


def by_rows(made, objective, particles):
    """Root of the sum of squares of IPOPT's rows, at the modes of each candidate's structure and its spectrum.

    NaN for a candidate that is no structure.
    """
    term, n = made.formulation.own_test, made.geometry.n
    x, modes = ca.MX.sym("x", made.n_variables), ModeSymbols(ca.MX.sym("shapes", n, n), ca.MX.sym("omega", n))
    function = ca.Function("rows", [x, *modes], [ca.norm_2(term.rows(x, modes))])
    values = []
    for s in particles:
        at = objective.unknowns(s)
        try:
            structure = made.structure(at)
        except sysid.InputError:
            values.append(np.nan)
            continue
        omega = 2 * np.pi * structure.natural_frequencies if objective.spectrum is None else objective.spectrum
        values.append(float(function(at, structure.normal_modes, omega)))
    return np.array(values)


def with_blocks(model, change):
    """The same model, its expressions changed."""

    class Changed(type(model)):
        def blocks(self, *given):
            return change(super().blocks(*given))

    made = object.__new__(Changed)
    made.__dict__.update(vars(model))
    return made


def scaled(part, by=1.05):
    """A change of one block."""
    return lambda made: made._replace(**{part: by * getattr(made, part)})


def times(made):
    return 1.05 * made


def sheared(made):
    """Another entry of K, and of H, which is the same where the mass is the unit matrix."""
    shift = ca.SX(N, N)
    shift[1, 1] = 0.1 * made.mass_normalised[0, 0]
    return sysid.StiffnessBlocks(made.stiffness + shift, made.mass_normalised + shift)


RING = CirculantStiffness((1e3, 1e5), (1e3, 1e5))
PARTS = ComponentMass(np.array([np.diag([2.0, 1, 1, 1]), np.diag([0.0, 1, 2, 0])]), [1.0, 1.0], [9.0, 9.0])
m = sysid.Variable("m", 3, lower=1.0, upper=9.0)
WRITTEN = ca.diag(ca.vertcat(m, 2.0, 2.0))
CHANGES = {
    "full mass, factor": ("mass", sysid.FullMass(30.0), scaled("factor"), {}),
    "full mass, coupling": ("mass", sysid.FullMass(30.0, healing="rigid_body"), scaled("coupling", 0.95), {}),
    "full mass, base": ("mass", sysid.FullMass(30.0), scaled("base"), {}),
    "lumped mass": ("mass", sysid.LumpedMass(30.0), scaled("factor"), {}),
    "known mass": ("mass", sysid.KnownMass(truth(G).mass), scaled("coupling", 0.95), {}),
    "own mass": ("mass", PARTS, times, {"rigid_body": ALONG}),
    "stiffness by its spectrum": ("stiffness", sysid.SpectralStiffness([3.0, 9.0, 16.0]), sheared,
                                  {"mass": sysid.KnownMass(np.eye(N + D))}),
    "chain": ("stiffness", sysid.ChainStiffness(1e3, 1e5), times, {"rigid_body": ALONG}),
    "ring": ("stiffness", RING, times, {"rigid_body": ALONG}),
}  # fmt: skip


def costs_of(made, particles):
    """The swarm's objective of candidates, checked against IPOPT's rows."""
    spectrum = made.formulation.stiffness.spectrum if made.formulation.refinable else None
    objective = SwarmObjective(made.prepared, spectrum=spectrum)
    assert (objective._held is None) == (spectrum is None)
    costs = objective(particles)
    np.testing.assert_allclose(costs, by_rows(made, objective, particles), rtol=1e-9)
    return costs


def agree(made, other):
    """Check the costs of two problems against the rows of each; and that they differ."""
    particles = np.random.default_rng(0).uniform(made.lower, made.upper, (COUNT, made.n_variables))
    before, after = costs_of(made, particles), costs_of(other, particles)
    there = np.isfinite(before)  # scales that are coupled do not exist for every candidate
    assert np.count_nonzero(there) > COUNT / 2
    assert np.median(np.abs(after / before - 1)[there]) > 1e-6


@pytest.mark.parametrize("case", CHANGES)
def test_a_coefficient_of_a_model_s_expressions_changes_both_alike(case):
    name, model, change, beside = CHANGES[case]
    agree(make({**beside, name: model}), make({**beside, name: with_blocks(model, change)}))


@pytest.mark.parametrize("healing", ["trace", "rigid_body"])
def test_a_coefficient_of_the_healing_changes_both_alike(monkeypatch, healing):
    mass = sysid.FullMass(30.0 * np.ones(D), healing=healing)
    made, heal = make({"mass": mass}), mass_models.heal
    particles = np.random.default_rng(0).uniform(made.lower, made.upper, (COUNT, made.n_variables))
    before = costs_of(made, particles)
    monkeypatch.setattr(mass_models, "heal", lambda factor, *given: 1.02 * heal(factor, *given))
    after, there = costs_of(make({"mass": mass}), particles), np.isfinite(before)
    assert np.count_nonzero(there) > COUNT / 2
    assert np.median(np.abs(after / before - 1)[there]) > 1e-6


@pytest.mark.parametrize(
    "damping", [sysid.ModalDamping(0.005, 0.05), sysid.ProportionalDamping((0.1, 2.0), (1e-5, 1e-3))]
)
def test_a_coefficient_of_damping_ratios_changes_both_alike(damping):
    class Changed(type(damping)):
        def ratios(self, *given):
            return 1.05 * super().ratios(*given)

    other = object.__new__(Changed)
    other.__dict__.update(vars(damping))
    agree(make({"damping": damping}), make({"damping": other}))


def test_a_coefficient_of_a_written_mass_changes_both_alike():
    agree(make({"mass": WRITTEN}), make({"mass": 1.05 * WRITTEN}))


def test_what_the_base_moves_keeps_its_digits_where_the_mass_is_ill_conditioned():
    """Of a factor with small diagonal entries, ``L' G + Z'`` by hand; through M_S0 it would have lost them."""
    n, rng = 14, np.random.default_rng(5)
    G = np.ones((n, 1))
    test = sysid.Measurement(FREQ, np.ones((1, 1, 30)), rng.normal(size=(1, n, 30)) + 0j, rigid_body=G)
    model = sysid.Problem(test, mass=sysid.FullMass(10.0), stiffness=sysid.SpectralStiffness(np.arange(1.0, n + 1)))
    factor = np.tril(rng.uniform(-1, 1, (n + 1, n + 1)), -1) + 0.02 * np.eye(n + 1)
    x = np.concatenate([factor[np.tril_indices(n + 1)], rng.uniform(1, 9, model.n_variables - (n + 1) * (n + 2) // 2)])
    healed = factor * np.sqrt(10.0 / np.sum(factor**2))
    symbol = ca.MX.sym("x", x.size)
    right = np.asarray(ca.Function("right", [symbol], [model.formulation.matrices.of_modes(symbol)[1]])(x))
    L, Z = healed[:n, :n], healed[n:, :n]
    expected = L.T @ G + Z.T
    np.testing.assert_allclose(right[:, n:], expected, rtol=1e-12, atol=1e-15)
    through_coupling = L.T @ G + np.linalg.solve(L, L @ Z.T)
    assert np.abs(through_coupling - expected).max() > 1e-6 * np.abs(expected).max()
