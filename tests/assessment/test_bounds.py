"""Which unknowns rest on bounds, and what of a misfit these explain: by hand, and by bounded linear least squares."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import lsq_linear

import sysid
from sysid.assessment.checks.stated import bounds_in_words, on_bounds, pressure, sides_of

FREQ = np.linspace(1.0, 12.0, 60)
STRETCH = np.array([[1.0, 0.0], [-1.0, 1.0]])
K = STRETCH.T @ np.diag([900.0, 400.0]) @ STRETCH
FULL = np.block([[K, -K @ np.ones((2, 1))], [-np.ones((1, 2)) @ K, np.full((1, 1), 900.0)]])
TRUTH = sysid.Structure(np.diag([2.0, 1.0, 0.0]), FULL, [0.002, 0.1], n_base=1)
TEST = sysid.simulate(TRUTH, FREQ, noise=0.01, rng=0)


def sides(lower, upper, values, relative=False):
    return sides_of(np.array(lower), np.array(upper), np.array(values), relative).tolist()


class TestSides:
    def test_a_millionth_of_the_range_is_on_the_bound(self):
        assert sides([1.0] * 4, [2.0] * 4, [1.0, 1 + 1e-7, 1 + 1e-5, 2.0]) == ["lower", "lower", "", "upper"]

    def test_where_the_range_spans_decades_what_is_near_the_bound_beside_its_size_is_on_it(self):
        """A millionth of this range is half of the lower bound."""
        assert sides([1e3] * 3, [1e9] * 3, [1.3e3, 1.00005e3, 0.9999999e9]) == ["", "lower", "upper"]

    def test_at_a_bound_of_zero_the_range_alone_counts(self):
        assert sides([0.0] * 2, [1e5] * 2, [0.05, 5.0]) == ["lower", ""]

    def test_shares_rest_on_a_positive_lower_bound_only(self):
        assert sides([1e-3] * 3, [1.0] * 3, [1e-3, 0.5, 1.0], relative=True) == ["lower", "", ""]
        assert sides([-1.0] * 2, [1.0] * 2, [-1.0, 1.0], relative=True) == ["", ""]


def places(problem, x):
    return [
        (one.name + one.entry, one.side, one.source) for one in on_bounds(problem.prepared, problem.structure(x), x)
    ]


def test_unknowns_of_models_and_variables_are_named_with_who_states_the_bound():
    c = sysid.Variable("c", 2, lower=0.0, upper=50.0)
    problem = sysid.Problem(
        TEST, mass=sysid.LumpedMass(3.0), stiffness=sysid.ChainStiffness(100.0, 900.0),
        damping=STRETCH.T @ ca.diag(c) @ STRETCH,
    )  # fmt: skip
    found = places(problem, np.array([1.0, 0.5, 900.0, 400.0, 3.0, 0.0]))
    assert found[:1] == [("spring 1", "upper", "ChainStiffness")]
    assert found[1][:2] == ("c[1]", "lower")
    assert "test_bounds.py, line" in found[1][2]
    assert places(problem, np.array([2.0, 1e-3 * 2.0, 500.0, 400.0, 3.0, 1.0])) == [
        ("mass share 2", "lower", "LumpedMass")
    ]


def test_entries_of_free_matrices_rest_on_no_bound():
    """L_H of one mode is its frequency, which is the largest that is searched."""
    problem = sysid.Problem(TEST, mass=sysid.FullMass(3.0), damping=sysid.ModalDamping(0.002, 0.2))
    x = problem.values(TRUTH)
    assert places(problem, x) == [("damping ratio 1", "lower", "ModalDamping")]


def test_a_stated_frequency_rests_on_the_edge_of_its_window():
    f = TRUTH.natural_frequencies
    problem = sysid.Problem(
        TEST, mass=sysid.LumpedMass(3.0), stiffness=sysid.SpectralStiffness([f[0] / 1.05, f[1] * 1.01])
    )
    assert places(problem, problem.values(TRUTH)) == [("natural frequency 1", "upper", "SpectralStiffness")]


def test_alike_bounds_are_told_together():
    problem = sysid.Problem(
        TEST, mass=np.diag([2.0, 1.0]), stiffness=sysid.ChainStiffness(400.0, 900.0), damping=np.eye(2)
    )
    found = on_bounds(problem.prepared, TRUTH, np.array([400.0, 400.0]))
    assert bounds_in_words(found) == "spring 1, 2 (lower, 400 N/m)"
    assert {one.source for one in found} == {"ChainStiffness"}


class TestPressure:
    @pytest.mark.parametrize("tied", [False, True])
    def test_of_a_linear_misfit_the_share_is_that_of_linear_least_squares(self, tied):
        """And of a misfit that the bound does not touch there is none."""
        rng = np.random.default_rng(0)
        A, b = rng.standard_normal((40, 3)), rng.standard_normal(40)
        if tied:  # x[1] = x[2]
            A = np.column_stack([A[:, 0], A[:, 1] + A[:, 2]])
        free = np.linalg.lstsq(A, b, rcond=None)[0]
        low = np.full(A.shape[1], -50.0)
        low[0] = free[0] + 0.4
        bounded = lsq_linear(A, b, (low, 50.0), tol=1e-14).x
        x = sysid.Variable("x", 3, lower=[low[0], -50.0, -50.0], upper=50.0, guess=[low[0] + 1, 0.0, 0.0])
        k = sysid.Variable("k", lower=1.0, upper=2.0)
        problem = sysid.Problem(
            TEST, mass=np.diag([2.0, 1.0]), stiffness=k * K, damping=np.eye(2), constraints=[x[1] == x[2]] * tied,
            misfit=ca.DM(A if not tied else np.column_stack([A, np.zeros(40)])) @ x.symbol - ca.DM(b) + 0 * k.symbol,
        )  # fmt: skip
        at = {"x": np.append(bounded, bounded[1:] if tied else []), "k": 1.5}
        values = np.concatenate([np.ravel(at[v.name]) for v in problem.variables])
        left = lambda z: np.sum((A @ z - b) ** 2)  # noqa: E731
        found = on_bounds(problem.prepared, problem.structure(values), values)
        assert [one.name + one.entry for one in found] == ["x[0]"]
        share = pressure(problem.prepared, problem.structure(values), values, found).share
        assert share == pytest.approx((left(bounded) - left(free)) / left(bounded), rel=1e-6)

    def test_bounds_explain_a_misfit_that_they_make_and_none_that_a_wrong_mass_makes(self):
        """Of the true mass a spring of at most 700 N/m, where it has 900; of a wrong one a damper of zero."""
        for mass, highest, explains in (([2.0, 1.0], 700.0, True), ([2.0, 1.6], 5e3, False)):
            k = sysid.Variable("k", 2, lower=50.0, upper=highest)
            ratio = sysid.Variable("ratio", 2, lower=[0.0019, 0.0], upper=0.3, guess=[0.002, 0.1])
            problem = sysid.Problem(TEST, mass=np.diag(mass), stiffness=STRETCH.T @ ca.diag(k) @ STRETCH, damping=ratio)
            result = sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))
            found = on_bounds(problem.prepared, result.structure, result.x)
            assert found
            assert pressure(problem.prepared, result.structure, result.x, found).explains is explains

    def test_exact_records_on_a_bound_press_on_nothing(self):
        exact = sysid.simulate(TRUTH, FREQ)
        problem = sysid.Problem(
            exact, mass=np.diag([2.0, 1.0]), stiffness=sysid.ChainStiffness(100.0, 900.0),
            damping=sysid.ModalDamping(0.001, 0.2),
        )  # fmt: skip
        x = np.array([900.0, 400.0, 0.002, 0.1])
        found = on_bounds(problem.prepared, TRUTH, x)
        assert len(found) == 1
        assert not pressure(problem.prepared, TRUTH, x, found).significant

    def test_of_free_modes_by_the_poles_of_the_data(self):
        problem = sysid.Problem(TEST, mass=sysid.FullMass(3.0), damping=sysid.ModalDamping(0.005, 0.05))
        narrow = sysid.Structure(TRUTH.mass, TRUTH.stiffness, [0.005, 0.05], n_base=1)
        x = problem.values(narrow)
        press = pressure(problem.prepared, narrow, x, on_bounds(problem.prepared, narrow, x))
        assert press.explains
        wide = replace(problem, damping=sysid.ModalDamping(0.002, 0.1))
        x = wide.values(TRUTH)
        found = on_bounds(wide.prepared, TRUTH, x)
        assert len(found) == 2
        assert not pressure(wide.prepared, TRUTH, x, found).significant
