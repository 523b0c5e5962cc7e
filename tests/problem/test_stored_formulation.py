"""A written problem comes back from disk as it was, and nothing that Python would run is in the file."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.search.continuation import Continuation
from sysid.search.swarm_objective import SwarmObjective

FREQ = np.linspace(1.0, 30.0, 40)
ONE = np.ones((2, 1))
MASSES, SPRINGS, DAMPERS = np.array([3.0, 2.0]), np.array([2e4, 1.5e4]), np.array([8.0, 5.0])
T = np.eye(2) - np.eye(2, k=-1)
pytestmark = pytest.mark.usefixtures("from_one_start_in_module")


def chain(k):
    return T.T @ np.diag(k) @ T if isinstance(k, np.ndarray) else ca.DM(T).T @ ca.diag(k) @ ca.DM(T)


def structure(masses=MASSES, **damping):
    K = chain(SPRINGS)
    damping = damping or {"damping_matrix": chain(DAMPERS)}
    whole = np.block([[K, -K @ ONE], [-ONE.T @ K, ONE.T @ K @ ONE]])
    return sysid.Structure(np.diag([*masses, 0.0]), whole, n_base=1, **damping)


def unknown(name, values, **options):
    values = np.asarray(values)
    return sysid.Variable(name, values.shape, lower=values / 3, upper=values * 3, guess=values * 1.1, **options)


def everything():
    """A fixed and a logarithmic variable, constraints, residuals, what is known, a further test, healing."""
    m, k, c = unknown("m", MASSES, unit="kg"), unknown("k", SPRINGS, log=True, unit="N/m"), unknown("c", DAMPERS)
    added = sysid.Variable("added", lower=0, upper=2, guess=0.7, fixed=True)
    test = sysid.simulate(structure(), FREQ, noise=0.01, rng=0)
    second = sysid.simulate(structure(MASSES + np.array([0, 0.7])), FREQ[::2], noise=0.01, force=True, rng=1)
    later = ca.diag(ca.vertcat(m[0], m[1] + added))
    return sysid.Problem(
        test, mass=ca.diag(m), stiffness=chain(k), damping=chain(c),
        residuals=[
            0.1 * (k[0] / k[1] - 4 / 3), sysid.FurtherTest(second, mass=later, stiffness=chain(k), damping=chain(c)),
            sysid.Prior(ca.vertcat(m[1], c[0], k[0] + k[1]), [2.0, 8.0, 3.5e4], [0.5, 2.0, 1e4]),
        ],
        constraints=[m[1] <= m[0], ca.sum1(m) == 5.0], healing={m: 5 * m / ca.sum1(m)}, goal=0.05,
    )  # fmt: skip


def recovered():
    """A sensor between two floors; ratios; base mass and coupling."""
    R = np.array([[0.4, 0.6]])
    m, k, z = unknown("m", MASSES), unknown("k", SPRINGS), unknown("z", [0.02, 0.03])
    one = structure(damping_ratios=[0.02, 0.03])
    seen = sysid.Structure(one.mass, one.stiffness, [0.02, 0.03], n_base=1, recovery=R, rigid_body=R @ ONE)
    mass = ca.blockcat([[ca.diag(m), 0.01 * m], [0.01 * m.T, 0.5]])
    return sysid.Problem(
        sysid.simulate(seen, FREQ, noise=0.01, force=True, rng=0), mass=mass, stiffness=chain(k), damping=z,
        recovery=R, rigid_body_dofs=ONE,
    )  # fmt: skip


def single():
    """One degree of freedom, whose ratio is a column of one."""
    k = unknown("k", 1e4)
    one = sysid.Structure(np.diag([2.0, 0]), 1e4 * np.array([[1, -1], [-1, 1.0]]), [0.02], n_base=1)
    return sysid.Problem(
        sysid.simulate(one, FREQ, noise=0.01, rng=0), mass=[[2.0]], stiffness=k, damping=sysid.ModalDamping()
    )


def models():
    """Models of the matrices beside a constraint."""
    k = unknown("k", SPRINGS)
    return sysid.Problem(
        sysid.simulate(structure(), FREQ, noise=0.01, rng=0), mass=sysid.LumpedMass(5.0), stiffness=chain(k),
        damping=sysid.ProportionalDamping((0.0, 5.0), (0.0, 1e-2)), constraints=[k[0] >= k[1]],
    )  # fmt: skip


def chained():
    """A chain whose springs are a model's, and are searched on a logarithmic scale."""
    s = unknown("s", 1.0)
    return sysid.Problem(
        sysid.simulate(structure(), FREQ, noise=0.01, rng=0), mass=s * np.diag(MASSES), damping=s * chain(DAMPERS),
        stiffness=sysid.ChainStiffness(1e3, 1e5), constraints=[s == 1.0],
    )  # fmt: skip


def by_size():
    """A misfit of its own: sizes of responses without their phases."""
    m, k, c = unknown("m", MASSES, fixed=True), unknown("k", SPRINGS), unknown("c", DAMPERS)
    test = sysid.simulate(structure(), FREQ, noise=0.01, rng=0)
    made = sysid.FurtherTest(test, mass=ca.diag(m), stiffness=chain(k), damping=chain(c)).response
    size = np.abs(test.response[0])
    misfit = ca.vec(ca.sqrt(made.real**2 + made.imag**2) - size) / np.linalg.norm(size)
    return sysid.Problem(test, mass=ca.diag(m), stiffness=chain(k), damping=chain(c), misfit=misfit)


KINDS = (everything, recovered, single, models, chained, by_size)


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: kind.__name__)
def pair(request, tmp_path_factory):
    """A result, and what came back from its file; the file."""
    before = sysid.identify(request.param(), rng=0, strategy=Continuation(starts=1))
    path = before.save(tmp_path_factory.mktemp("stored") / "result.h5")
    return before, sysid.load(path), path


def test_unknowns_values_and_structure_are_the_same_bits(pair):
    before, after, _ = pair
    np.testing.assert_array_equal(after.x, before.x)
    for name in (v.name for v in before.problem.variables):
        value = before.values[name]
        np.testing.assert_array_equal(after.values[name], value)
        assert np.shape(after.values[name]) == np.shape(value)
    for name in ("mass", "stiffness", "damping", "damping_ratios", "recovery"):
        np.testing.assert_array_equal(getattr(after.structure, name), getattr(before.structure, name))
    assert (after.success, after.message, after.determined) == (before.success, before.message, before.determined)
    assert (after.closed_by, after.undetermined, after.problem.goal) == (
        before.closed_by, before.undetermined, before.problem.goal
    )  # fmt: skip


def test_the_problem_has_the_same_variables(pair):
    before, after, _ = pair
    for old, new in zip(before.problem.variables, after.problem.variables, strict=True):
        assert (new.name, new.size, new.unit) == (old.name, old.size, old.unit)
        np.testing.assert_array_equal(new.lower, old.lower)
        np.testing.assert_array_equal(new.upper, old.upper)
        if isinstance(old, sysid.Variable):
            assert (new.shape, new.log, new.has_guess) == (old.shape, old.log, old.has_guess)
            np.testing.assert_array_equal(new.guess, old.guess)


def test_fixed_variables_come_back_and_labels(pair):
    before, after, _ = pair
    old, new = (side.problem.formulation for side in (before, after))
    assert [v.name for v in new.fixed] == [v.name for v in old.fixed]
    assert after.values.keys() == before.values.keys()
    assert new.labels == old.labels


def test_every_function_of_the_unknowns_is_the_same(pair):
    before, after = (side.problem for side in pair[:2])
    for x in (before.formulation.guess, pair[0].x, 0.4 * before.lower + 0.6 * before.upper):
        old, new = before.structure(x), after.structure(x)
        for name in ("mass", "stiffness", "damping", "rigid_body_dofs"):
            np.testing.assert_allclose(
                getattr(new, name), getattr(old, name), rtol=1e-13, atol=1e-13 * np.abs(getattr(old, name)).max()
            )
        assert after.objective(x) == pytest.approx(before.objective(x), rel=1e-10)
        assert after.residual(x) == pytest.approx(before.residual(x), rel=1e-10)
        f, g = before.formulation, after.formulation
        np.testing.assert_allclose(np.asarray(g.healing(x)), np.asarray(f.healing(x)), rtol=1e-13)
        for old_term, new_term in zip(f.terms, g.terms, strict=True):
            assert new_term.error(x) == pytest.approx(old_term.error(x), rel=1e-10)
    assert len(after.formulation.further_tests) == len(before.formulation.further_tests)


def test_constraints_are_the_same(pair):
    old, new = (side.problem.formulation.constraints for side in pair[:2])
    np.testing.assert_array_equal(new.lower, old.lower)
    np.testing.assert_array_equal(new.upper, old.upper)
    x = pair[0].x
    np.testing.assert_allclose(new.at(x), old.at(x), rtol=1e-13, atol=1e-12)


def test_the_uncertainty_is_the_same(pair):
    before, after = (side.uncertainty for side in pair[:2])
    for name, std in before.variables.items():
        np.testing.assert_allclose(after.variables[name], std, rtol=1e-6)
    for name in ("natural_frequencies", "damping_ratios", "mass", "stiffness", "damping"):
        old = getattr(before, name)
        np.testing.assert_allclose(getattr(after, name), old, rtol=1e-6, atol=1e-8 * np.nanmax(np.abs(old)))


def test_saved_again_it_is_the_same_again(pair, tmp_path):
    _, after, _ = pair
    again = sysid.load(after.save(tmp_path / "again.h5"))
    np.testing.assert_array_equal(again.x, after.x)
    assert again.problem.objective(again.x) == pytest.approx(after.problem.objective(after.x), rel=1e-12)


def test_the_swarm_sees_the_same_cost(pair):
    before, after = (side.problem for side in pair[:2])
    rows = np.random.default_rng(0).uniform(before.lower, before.upper, (20, before.n_variables))
    np.testing.assert_allclose(SwarmObjective(after.prepared)(rows), SwarmObjective(before.prepared)(rows), rtol=1e-9)


def test_the_swarms_coordinates_are_the_same(pair):
    before, after = (side.problem for side in pair[:2])
    for x in np.random.default_rng(1).uniform(before.lower, before.upper, (5, before.n_variables)):
        np.testing.assert_array_equal(after.formulation.to_sampling(x), before.formulation.to_sampling(x))


@pytest.mark.parametrize("kind", [single, models, chained], ids=lambda kind: kind.__name__)
def test_models_beside_expressions_come_back_as_models(kind):
    before = kind()
    after = sysid.Problem.from_tree(before.to_tree())
    for name in ("mass", "stiffness", "damping"):
        old, new = getattr(before, name), getattr(after, name)
        if isinstance(old, sysid.KnownMass | sysid.LumpedMass | sysid.ChainStiffness | sysid.ProportionalDamping):
            assert type(new) is type(old)
            for field, value in vars(old).items():
                np.testing.assert_array_equal(getattr(new, field), value)
    assert isinstance(before.stiffness, sysid.ChainStiffness) == (kind is chained)


def test_names_and_lines_of_the_author_are_kept(pair):
    """For tables and messages, which tell the line of a variable's declaration, and not that of the loading."""
    before, after = (side.problem.formulation for side in pair[:2])
    assert after.labels == before.labels
    assert after.members == before.members
    assert [prior.labels for prior in after.priors] == [prior.labels for prior in before.priors]
    assert after.declarations == before.declarations
    assert [v.declared for v in after.fixed] == [v.declared for v in before.fixed]


def test_the_file_holds_text_and_numbers_and_no_pickle(pair):
    import h5py

    found = []

    def look(name, item):
        for value in (*item.attrs.values(), item[()] if isinstance(item, h5py.Dataset) else 0.0):
            array = np.asarray(value)
            assert array.dtype.kind in "biufcSUO", name
            if array.dtype.kind in "SO":
                texts = [v if isinstance(v, bytes) else str(v).encode() for v in array.ravel().tolist()]
                assert all(not text.startswith(b"\x80") and b"cbuiltins" not in text for text in texts)
                found.extend(texts)

    with h5py.File(pair[2], "r") as file:
        file.visititems(look)
        assert int(file.attrs["format"]) == 5
    assert found


def callback():
    """The same column, through Python."""

    class Same(ca.Callback):
        def __init__(self):
            ca.Callback.__init__(self)
            self.construct("same", {"enable_fd": True})

        def get_n_in(self):
            return 1

        def get_n_out(self):
            return 1

        def get_sparsity_in(self, i):
            return ca.Sparsity.dense(2, 1)

        def get_sparsity_out(self, i):
            return ca.Sparsity.dense(2, 1)

        def eval(self, values):
            return [values[0] * 1.0]

    return Same()


@pytest.fixture(scope="module")
def of_a_callback():
    """A result whose stiffness holds a Python callback, and the same problem without it."""
    test, same = sysid.simulate(structure(), FREQ, noise=0.01, rng=0), callback()

    def problem(spring=lambda k: k, name="k", test=test):
        k = unknown(name, SPRINGS)
        prior = sysid.Prior(k[0], 1.01 * SPRINGS[0], 500.0)
        given = {"mass": np.diag(MASSES), "damping": chain(DAMPERS)}
        return sysid.Problem(test, stiffness=chain(spring(k)), residuals=[prior], **given)

    result = sysid.identify(problem(same), rng=0, strategy=sysid.Continuation(starts=1))
    return result, problem, same


def stored_without(of_a_callback, tmp_path):
    with pytest.warns(
        UserWarning, match=r"is without the expressions of its problem, as the function 'same' \(Callback"
    ):
        return of_a_callback[0].save(tmp_path)


def test_a_result_with_a_callback_is_stored_and_tells_all_that_readers_ask(of_a_callback, tmp_path):
    result, path = of_a_callback[0], stored_without(of_a_callback, tmp_path)
    back = sysid.load(path)
    assert result.success and back.summary() == result.summary() and back.to_dict() == result.to_dict()
    for name in ("mass", "natural_frequencies", "covariance"):
        np.testing.assert_array_equal(getattr(back.uncertainty, name), getattr(result.uncertainty, name))
    at = np.linspace(1.0, 30.0, 7)
    np.testing.assert_array_equal(back.uncertainty.transmissibility(at), result.uncertainty.transmissibility(at))
    np.testing.assert_array_equal(back.values["k"], result.values["k"])
    assert back.residual == result.residual and back.outliers == result.outliers
    assert sysid.load(back.save(tmp_path / "again")).summary() == result.summary()


def test_a_result_without_its_problem_says_what_it_needs(of_a_callback, tmp_path):
    back = sysid.load(stored_without(of_a_callback, tmp_path))
    with pytest.raises(
        sysid.InputError, match=r"the function 'same' \(Callback.* in stiffness cannot be .*problem=\.\.\."
    ):
        _ = back.problem


def test_a_problem_of_the_same_records_and_unknowns_is_taken(of_a_callback, tmp_path):
    result, problem, same = of_a_callback
    back = sysid.load(stored_without(of_a_callback, tmp_path), problem=problem(same))
    assert back.problem.objective(back.x) == result.objective
    assert back.x.tobytes() == result.x.tobytes() and back.history.log == result.history.log


def test_another_problem_is_not_taken(of_a_callback, tmp_path):
    (_, problem, same), path = of_a_callback, stored_without(of_a_callback, tmp_path)
    others = {
        "other records": problem(same, test=sysid.simulate(structure(), FREQ, noise=0.01, rng=1)),
        "other unknowns than the result: c": problem(same, name="c"),
        "stand for another stiffness matrix": problem(lambda k: 2 * same(k)),
        "is a int, not a sysid.Problem": 3,
    }
    for words, other in others.items():
        with pytest.raises(sysid.InputError, match=words):
            sysid.load(path, problem=other)
