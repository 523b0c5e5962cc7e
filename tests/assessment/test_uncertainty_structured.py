"""Standard deviations of structured models against finite differences in their own unknowns."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

import sysid
from sysid import LumpedMass, SpectralStiffness, Structure
from sysid.assessment.uncertainty import uncertainty
from sysid.measurement.whole import NoiseLevels
from sysid.modal_analysis.modal_estimate import Gains, ModalEstimate
from sysid.problem.prepared import Prepared


@pytest.fixture(autouse=True)
def gains_as_stated(monkeypatch):
    """No error of a gain among what is not known, which chance would add in some of these draws."""
    shown = lambda modal, structure: SimpleNamespace(possible=np.zeros(modal.records.n_sensors))  # noqa: E731
    monkeypatch.setattr("sysid.assessment.uncertainty.gain_errors", shown)


def check(u, expected, names, rtol):
    for name in names:
        np.testing.assert_allclose(
            getattr(u, name), expected[name], rtol=rtol, atol=1e-9 * expected[name].max(), err_msg=name
        )


def by_unknowns(problem, truth, unknowns, build, names):
    """Standard deviations by a finite-difference Fisher matrix in any unknowns, `build` taking them to a structure."""
    test = problem.measurement

    def records(structure):
        parts = [(test.predict(structure) / test.response_std).ravel()]
        if test.force is not None:
            parts.append((test.predict_force(structure) / test.force_std).ravel())
        stacked = np.concatenate(parts)
        return np.concatenate([stacked.real, stacked.imag]) * np.sqrt(2)

    def cut(structure, name):
        value = getattr(structure, name)
        return value[: truth.n, : truth.n] if name in ("mass", "stiffness", "damping") else value

    J, Q = [], {name: [] for name in names}
    for p, value in enumerate(unknowns):
        step = np.zeros(unknowns.size)
        step[p] = 1e-6 * max(abs(value), 0.1 * np.abs(unknowns).min())
        low, high = build(unknowns - step), build(unknowns + step)
        J.append((records(high) - records(low)) / (2 * step[p]))
        for name in names:
            Q[name].append((cut(high, name) - cut(low, name)) / (2 * step[p]))
    J = np.array(J).T
    scale = np.maximum(np.linalg.norm(J, axis=0), 1e-30)
    inverse = np.linalg.pinv(J / scale, rcond=1e-7) / scale[:, None]
    covariance = inverse @ inverse.T
    return {name: np.sqrt(np.einsum("p...,pq,q...->...", Q[name], covariance, Q[name])) for name in names}


class TestStructuredModels:
    NAMES = ("natural_frequencies", "damping_ratios", "mass", "stiffness", "damping", "participation")

    def lumped_unknowns(self, problem, truth, *, total):
        """m_i (all but the last, where the total ties it), entries of K_SS, damping ratios."""
        n, G = truth.n, truth.rigid_body
        low = np.tril_indices(n)
        m = np.diag(truth.mass)[:n]
        fixed = 1 if total else 0

        def build(x):
            masses, entries, ratios = np.split(x, [n - fixed, n - fixed + low[0].size])
            masses = np.append(masses, m.sum() - masses.sum()) if total else masses
            K = np.zeros((n, n))
            K[low] = entries
            K = K + np.tril(K, -1).T
            full = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
            return Structure(np.diag([*masses, *np.zeros(G.shape[1])]), full, ratios, n_base=G.shape[1])

        at = np.concatenate([m[: n - fixed], truth.stiffness[:n, :n][low], truth.damping_ratios])
        return by_unknowns(problem, truth, at, build, self.NAMES)

    @pytest.mark.parametrize("force", [False, True])
    def test_lumped_mass_in_its_own_unknowns(self, random_case, force):
        truth, problem = random_case(
            np.random.default_rng(14), "lumped", n=4, d=1, force=force, total=not force, noise=0.01
        )
        expected = self.lumped_unknowns(problem, truth, total=not force)
        u = uncertainty(problem.prepared, truth, problem.values(truth))
        check(u, expected, self.NAMES, rtol=1e-5)
        assert np.all(np.isfinite(u.mass)) and np.all(u.mass[np.tril_indices(4, -1)] < 1e-9 * u.mass[0, 0])

    @pytest.mark.parametrize("stiffness", ["spectral", "chain"])
    def test_without_any_mass_the_scale_is_open(self, random_case, stiffness):
        """Frequencies and what no common scale changes stay known."""
        truth, problem = random_case(np.random.default_rng(15), "lumped", stiffness, n=4, d=1, total=False, noise=0.01)
        u = uncertainty(problem.prepared, truth, problem.values(truth))
        assert np.all(np.isnan(np.diag(u.mass))) and np.all(np.isnan(np.diag(u.stiffness)))
        assert np.all(np.isnan(np.diag(u.damping))) and np.all(np.isnan(u.participation))
        assert np.all(np.isnan(u.mode_shapes)) and np.all(np.isnan(u.rigid_body_mass))
        assert np.all(np.isfinite(u.natural_frequencies))
        assert np.all(np.isfinite(u.transmissibility(problem.measurement.freq)))
        if stiffness == "spectral":
            total = np.diag(truth.mass)[:4].sum()
            with_total = dataclasses.replace(problem, mass=LumpedMass(total))
            expected = self.lumped_unknowns(with_total, truth, total=True)
            check(u, expected, ("natural_frequencies", "damping_ratios"), rtol=1e-5)

    @pytest.mark.parametrize(
        ("mass", "stiffness", "damping", "force", "total"),
        [
            ("lumped", "chain", "proportional", False, True),
            ("lumped", "spectral", "proportional", True, False),
            ("known", "spectral", "modal", False, True),
            ("trace", "chain", "modal", True, True),
            ("rigid_body", "chain", "proportional", True, False),
        ],
    )
    def test_in_the_unknowns_of_the_problem(self, random_case, mass, stiffness, damping, force, total):
        truth, problem = random_case(
            np.random.default_rng(16), mass, stiffness, damping, n=3, d=2, force=force, total=total, noise=0.01
        )
        expected = by_unknowns(problem, truth, problem.values(truth), problem.structure, self.NAMES)
        u = uncertainty(problem.prepared, truth, problem.values(truth))
        names = [name for name in self.NAMES if mass != "known" or name != "mass"]
        check(u, expected, names, rtol=1e-4)
        if mass == "known":
            assert np.all(u.mass < 1e-10 * np.diag(truth.mass).max())


def test_where_damping_is_a_matrix_the_scatter_of_modes_of_whole_records_does_not_count():
    """Their modes are normal ones, and this structure has none: it is fitted to the lines, and judged by them."""
    K = 2000.0 * np.array([[2.0, -1, -1], [-1, 1, 0], [-1, 0, 1]])
    truth = Structure(np.diag([5.0, 4.0, 0.0]), K, damping_matrix=np.array([[9.0, -2], [-2, 3]]), n_base=1)
    test = sysid.simulate(truth, np.linspace(0.5, 8.0, 200), noise=0.03, rng=1)
    test = dataclasses.replace(test, response_std=test.response_std / 3)
    k, c = sysid.Variable("k", lower=1e3, upper=4e3), sysid.Variable("c", 3, lower=-10, upper=10)
    size = 2 * 2 + 2 + 2 + 2 + 1
    modes = ModalEstimate(
        test, test, truth.mode_shapes, truth.participation, 2 * np.pi * truth.natural_frequencies, truth.damping_ratios,
        truth.rigid_body_mass, np.eye(size), NoiseLevels([0.1], [0.1]), 4.0, np.ones(1),
        Gains(np.zeros(2), np.ones(2), 100, np.zeros((size, 2)), np.zeros((2, 1)), np.zeros(2)), scatter=np.eye(size),
    )  # fmt: skip
    found = []
    for modal in (ModalEstimate.of_lines(test), modes):
        problem = sysid.Problem(
            test, mass=np.diag([5.0, 4.0]), stiffness=k * K[:2, :2] / 2000,
            damping=[[c[0], c[1]], [c[1], c[2]]],
        )  # fmt: skip
        at = {"k": 2000.0, "c[0]": 9.0, "c[1]": -2.0, "c[2]": 3.0}
        prepared = Prepared(problem, [modal])
        found.append(uncertainty(prepared, truth, np.array([at[label] for label in problem.formulation.labels])))
    plain, beside = found
    assert plain.inflation == pytest.approx(3.0, rel=0.1)
    assert beside.inflation == pytest.approx(plain.inflation, rel=1e-12)
    for name, std in plain.variables.items():
        np.testing.assert_allclose(beside.variables[name], std, rtol=1e-9)


@pytest.mark.parametrize("mass", ["known", "lumped"])
def test_repeated_frequencies_of_a_structured_model_are_the_limit_of_close_ones(mass):
    def stds(apart):
        M, K = np.diag([5.0, 4.0, 5.0, 4.0, 0.0, 0.0]), np.zeros((6, 6))
        for floors, factor in (([0, 1, 4], 1.0), ([2, 3, 5], 1.0 + apart)):  # along x, and along y
            K[np.ix_(floors, floors)] = 2000.0 * factor * np.array([[2.0, -1, -1], [-1, 1, 0], [-1, 0, 1]])
        truth = Structure(M, K, [0.01, 0.01, 0.02, 0.02], n_base=2)
        test = sysid.simulate(truth, np.linspace(0.5, 8.0, 200), noise=0.01, rng=1)
        given = sysid.KnownMass(M) if mass == "known" else LumpedMass(9.0)
        stiffness = SpectralStiffness(truth.natural_frequencies)
        problem = sysid.Problem(test, mass=given, stiffness=stiffness)
        return uncertainty(problem.prepared, truth, problem.values(truth))

    one, close = stds(0.0), stds(2e-5)
    for name in ("natural_frequencies", "damping_ratios", "stiffness", "damping"):
        np.testing.assert_allclose(getattr(one, name), getattr(close, name), rtol=2e-3, err_msg=name)
