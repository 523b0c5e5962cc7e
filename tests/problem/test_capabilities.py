"""Properties of a formulation: free modes, refinement, what stands apart, and which unknowns enter what."""

import casadi as ca
import numpy as np
import pytest

import sysid

FREQ = np.linspace(1.0, 12.0, 10)
FREQUENCIES = [2.0, 5.0, 9.0]
TEST = sysid.Measurement(FREQ, np.ones((1, 1, 10)), np.arange(30.0).reshape(1, 3, 10), rigid_body=np.ones((3, 1)))
STIFF = np.array([[300.0, -100, 0], [-100, 200, -100], [0, -100, 100]])


def other():
    return sysid.Variable("other", lower=0.5, upper=2.0)


def matrix(name):
    v = sysid.Variable(name, 3, lower=0.5, upper=5.0)
    return v, ca.diag(v)


def formulation(mass=None, stiffness=None, damping=None, **given):
    problem = sysid.Problem(
        TEST, mass=sysid.FullMass(6.0) if mass is None else mass,
        stiffness=sysid.SpectralStiffness(FREQUENCIES) if stiffness is None else stiffness,
        damping=sysid.ModalDamping() if damping is None else damping, **given,
    )  # fmt: skip
    return problem.formulation


def unrelated_prior():
    return {"residuals": [sysid.Prior(other(), 1.0, 0.1)]}


def unrelated_constraint():
    return {"constraints": [other() <= 1.5]}


def unrelated_test():
    """Of a structure of its own."""
    k = sysid.Variable("elsewhere", 3, lower=50.0, upper=500.0)
    return {"residuals": [sysid.FurtherTest(TEST, mass=np.eye(3), stiffness=ca.diag(k), damping=0.1 * np.eye(3))]}


UNRELATED = {
    "nothing": dict,
    "a prior": unrelated_prior,
    "a constraint": unrelated_constraint,
    "a test": unrelated_test,
}


class TestFreeModes:
    @pytest.mark.parametrize("beside", UNRELATED)
    @pytest.mark.parametrize("damping", [sysid.ModalDamping(), sysid.ProportionalDamping((0, 1), (0, 1e-3))])
    def test_a_full_mass_with_a_free_stiffness_and_what_does_not_touch_them(self, damping, beside):
        f = formulation(damping=damping, **UNRELATED[beside]())
        assert f.test_alone
        assert f.free_modes
        assert f.refinable
        assert all(f.apart)

    @pytest.mark.parametrize(
        "given",
        [
            lambda: {"mass": sysid.LumpedMass(6.0)},
            lambda: {"mass": np.eye(3)},
            lambda: {"mass": matrix("m")[1]},
            lambda: {"stiffness": sysid.ChainStiffness(10.0, 1e3)},
            lambda: {"stiffness": STIFF + matrix("k")[1]},
            lambda: {"damping": [0.01, 0.02, 0.03]},
            lambda: {"damping": 0.01 * matrix("z")[0]},
            lambda: {"damping": matrix("c")[1]},
            lambda: {"misfit": other() - 1},
        ],
    )
    def test_any_matrix_of_another_kind_or_a_misfit_of_one_s_own_ends_it(self, given):
        assert not formulation(**given()).free_modes

    def test_sensors_that_combine_degrees_of_freedom_end_it(self):
        recovery = np.array([[0.5, 0.5, 0], [0, 1, 0], [0, 0, 1]])
        f = formulation(recovery=recovery, rigid_body_dofs=np.ones((3, 1)))
        assert f.test_alone
        assert not f.free_modes

    def test_an_unknown_of_the_damping_is_touched_by_what_is_written_in_it(self):
        """A damping written in a variable that a constraint holds: nothing is apart."""
        z = sysid.Variable("z", 3, lower=0.001, upper=0.1)
        f = formulation(damping=z, constraints=[z[0] <= z[1]])
        assert not f.test_alone


class TestRefinement:
    """The spectrum can be replaced where the stiffness is free, damping by ratios, and nothing else tells of either."""

    @pytest.mark.parametrize("beside", UNRELATED)
    @pytest.mark.parametrize("mass", [sysid.LumpedMass(6.0), np.eye(3)], ids=["lumped", "known"])
    def test_whatever_the_mass(self, mass, beside):
        assert formulation(mass, **UNRELATED[beside]()).refinable

    @pytest.mark.parametrize("damping", [[0.01, 0.02, 0.03], sysid.ProportionalDamping((0, 1), (0, 1e-3))])
    def test_whatever_the_ratios(self, damping):
        assert formulation(damping=damping).refinable

    def test_not_beside_a_damping_matrix(self):
        assert not formulation(damping=matrix("c")[1]).refinable

    def test_not_where_the_stiffness_has_a_form(self):
        assert not formulation(stiffness=sysid.ChainStiffness(10.0, 1e3)).refinable

    @pytest.mark.parametrize("relation", ["prior", "constraint", "test", "healing", "misfit"])
    def test_not_where_something_else_tells_of_the_mass(self, relation):
        m, M = matrix("m")
        given = {
            "prior": {"residuals": [sysid.Prior(m[0] + m[1], 2.0, 0.1)]},
            "constraint": {"constraints": [m[0] <= other()]},
            "test": {"residuals": [sysid.FurtherTest(TEST, mass=M, stiffness=STIFF, damping=np.eye(3))]},
            "healing": {"healing": {m: 6 * m / ca.sum1(m)}},
            "misfit": {"misfit": m - 1},
        }[relation]
        assert formulation(M).refinable
        assert not formulation(M, **given).refinable


class TestApart:
    def test_each_source_for_itself(self):
        m, M = matrix("m")
        u = other()
        residuals = [
            sysid.Prior(u, 1.0, 0.1), sysid.Prior(m[2], 1.0, 0.1), u**2 - 1, u * m[0] - 1,
            sysid.FurtherTest(TEST, mass=np.eye(3), stiffness=u * STIFF, damping=np.eye(3)),
            sysid.FurtherTest(TEST, mass=M, stiffness=STIFF, damping=np.eye(3)),
        ]  # fmt: skip
        f = formulation(M, residuals=residuals)
        assert f.apart == (True, False, True, False, True, False)
        assert not f.test_alone

    def test_a_constraint_between_both_ties_them(self):
        m, M = matrix("m")
        u = other()
        apart = formulation(M, residuals=[sysid.Prior(u, 1.0, 0.1)], constraints=[u <= 1.5])
        tied = formulation(M, residuals=[sysid.Prior(u, 1.0, 0.1)], constraints=[u == m[0]])
        assert apart.apart == tied.apart == (True,)
        assert apart.test_alone
        assert not tied.test_alone

    def test_outside_are_the_entries_that_enter_no_matrix(self):
        f = formulation(matrix("m")[1], residuals=[sysid.Prior(other(), 1.0, 0.1)])
        # Six of L_H, three ratios, three masses, and the other.
        np.testing.assert_array_equal(f.outside, [False] * 12 + [True])
        assert f.labels[-1] == "other"
        assert not np.any(formulation().outside)


class TestMembers:
    def test_models_have_their_own_and_written_matrices_all_that_enters_them(self):
        m, M = matrix("m")
        u, fixed = other(), sysid.Variable("held", lower=0.0, upper=2.0, guess=1.0, fixed=True)
        f = formulation(
            M, damping=fixed * M + 0.01 * STIFF, residuals=[u - 1, sysid.Prior(m[0], 1.0, 0.1)],
            constraints=[u <= m[1]],
        )  # fmt: skip
        assert f.members == (
            ("mass", ("m",)), ("stiffness", ("stiffness_factor",)), ("damping", ("m",)), ("residuals", ("m", "other")),
            ("constraints", ("m", "other")),
        )  # fmt: skip
        assert "'m' (" in f.declarations["mass"]
        assert f.declarations["stiffness"] == ""
        assert "'held' (" in f.declarations["damping"]

    def test_a_misfit_and_further_tests_are_listed_apart(self):
        k = sysid.Variable("k", 3, lower=50.0, upper=500.0)
        further = sysid.FurtherTest(TEST, mass=np.eye(3), stiffness=ca.diag(k), damping=0.1 * np.eye(3))
        f = formulation(misfit=other() - 1, residuals=[further])
        names = dict(f.members)
        assert names["misfit"] == ("other",)
        assert names["further tests"] == ("k",)

    def test_two_models_with_unknowns_of_one_name_are_refused(self):
        class Springs(sysid.ChainStiffness):
            def unknowns(self, geometry):
                (spring,) = super().unknowns(geometry)
                spring.name = "mass_share"
                return (spring,)

        with pytest.raises(sysid.InputError, match="'mass_share'"):
            formulation(sysid.LumpedMass(6.0), Springs(10.0, 1e3))


class TestTotals:
    """Which masses a problem knows, and whether any number has a unit of mass."""

    @pytest.mark.parametrize(
        ("mass", "unit", "totals"),
        [
            (lambda: sysid.FullMass(), True, 1.0),
            (lambda: sysid.LumpedMass(), True, 1.0),
            (lambda: sysid.FullMass(6.0), False, 6.0),
            (lambda: sysid.FullMass([[7.0]], healing="rigid_body"), False, 7.0),
            (lambda: sysid.FullMass(known=np.diag([2.0, np.nan, np.nan])), False, 1.0),
            (lambda: np.diag([1.0, 2.0, 3.0]), False, 6.0),
            (lambda: ca.diag(sysid.Variable("m", 3, lower=1.0, upper=3.0)), False, 6.0),
        ],
    )
    def test_without_a_force(self, mass, unit, totals):
        problem = sysid.Problem(TEST, mass=mass(), stiffness=sysid.SpectralStiffness(FREQUENCIES))
        assert problem.prepared.unit_mass is unit
        np.testing.assert_allclose(problem.totals, totals)

    def test_entries_and_the_rigid_body_mass(self):
        known = np.full((3, 3), np.nan)
        known[0, 1] = 0.2
        problem = sysid.Problem(TEST, mass=sysid.FullMass(known=known), stiffness=sysid.SpectralStiffness(FREQUENCIES))
        expected = np.full((3, 4), np.nan)
        expected[0, 1] = expected[1, 0] = 0.2
        np.testing.assert_array_equal(problem.prepared.known_mass, expected)
        assert problem.prepared.rigid_total is None
        whole = sysid.FullMass([[7.0]], healing="rigid_body")
        problem = sysid.Problem(TEST, mass=whole, stiffness=sysid.SpectralStiffness(FREQUENCIES))
        np.testing.assert_array_equal(problem.prepared.rigid_total, [[7.0]])
        assert np.all(np.isnan(problem.prepared.known_mass))
