"""Matrix models that are not of the package: against NumPy, their inverses, and what a problem makes of them."""

import importlib
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.problem.stored import model_from_tree, model_to_tree

with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(str(Path(__file__).parent))
    own = importlib.import_module("own_models")

SPRINGS = {2: [3e4, 5e3], 3: [3e4, 5e3], 4: [3e4, 5e3, 2e3], 5: [3e4, 5e3, 2e3], 6: [3e4, 5e3, 2e3, 7e2]}


def ring(n):
    """A spring to the base at each sector, and springs from each sector to those at every distance, both ways round."""
    ground, *couplings = SPRINGS[n]
    K = ground * np.eye(n)
    for distance, k in enumerate(couplings, start=1):
        for i in range(n):
            j = (i + distance) % n
            strain = np.zeros(n)
            strain[i], strain[j] = 1, -1
            K += k * np.outer(strain, strain)
    return K


def rods(volumes=(2e-3, 1e-3, 3e-3), of=(0, 1, 0)):
    """Mass for unit density of rods from the base to each sensor, by two components: v/3 at its ends, v/6 between."""
    n = len(volumes)
    forms = np.zeros((2, n + 1, n + 1))
    for i, (v, c) in enumerate(zip(volumes, of, strict=True)):
        forms[c, i, i], forms[c, n, n] = v / 3, forms[c, n, n] + v / 3
        forms[c, i, n] = forms[c, n, i] = v / 6
    return forms


def structure(M, K):
    n = len(K)
    one = np.ones((n, 1))
    whole = np.block([[K, -K @ one], [-one.T @ K, one.T @ K @ one]])
    return sysid.Structure(M, whole, np.full(n, 0.01), n_base=1)


@pytest.mark.parametrize("n", SPRINGS)
def test_a_ring_of_springs_and_its_inverse(geometry_of, n):
    geometry, model = geometry_of(np.ones((n, 1))), own.CirculantStiffness((1e3, 1e6), (1e2, 1e5))
    assert isinstance(model, sysid.MatrixModel)
    y = ca.SX.sym("y", sum(u.size for u in model.unknowns(geometry)))
    K = np.asarray(ca.densify(ca.Function("K", [y], [model.blocks(geometry, y, None)])(SPRINGS[n])))
    np.testing.assert_allclose(K, ring(n), rtol=1e-14)
    held = structure(np.eye(n + 1), K)
    np.testing.assert_allclose(model.values(geometry, held), SPRINGS[n], rtol=1e-9)
    K[0, 0] *= 1.1
    with pytest.raises(sysid.InputError, match="not circulant"):
        model.values(geometry, structure(np.eye(n + 1), K))


def test_components_of_unknown_density_and_their_inverse(geometry_of):
    geometry, forms = geometry_of(np.ones((3, 1))), rods()
    model = own.ComponentMass(forms, [1000.0, 1000.0], [9000.0, 9000.0])
    y = ca.SX.sym("y", 2)
    M = np.asarray(ca.densify(ca.Function("M", [y], [model.blocks(geometry, y)])([2700.0, 7800.0])))
    np.testing.assert_allclose(M, 2700 * forms[0] + 7800 * forms[1], rtol=1e-14)
    np.testing.assert_allclose(model.values(geometry, structure(M, ring(3))), [2700, 7800], rtol=1e-12)
    with pytest.raises(sysid.InputError, match="not made of these components"):
        model.values(geometry, structure(M + np.diag([0.1, 0, 0, 0]), ring(3)))


def test_a_problem_of_them(geometry_of):
    forms = rods()
    M, K = 2700 * forms[0] + 7800 * forms[1], ring(3)
    truth = structure(M, K)
    problem = sysid.Problem(
        sysid.simulate(truth, np.linspace(5, 80, 40)), mass=own.ComponentMass(forms, [1e3, 1e3], [9e3, 9e3]),
        stiffness=own.CirculantStiffness((1e3, 1e6), (1e2, 1e5)),
    )  # fmt: skip
    x = problem.values(truth)
    np.testing.assert_allclose(x, [2700, 7800, *SPRINGS[3], 0.01, 0.01, 0.01], rtol=1e-9)
    made, G = problem.formulation.matrices.numbers(x), np.ones((3, 1))
    L = np.linalg.cholesky(M[:3, :3])
    for block, expected in (
        (made.mass, M[:3, :3]), (made.coupling, M[:3, 3:]), (made.base, M[3:, 3:]), (made.stiffness, K),
        (made.mass_normalised, np.linalg.solve(L, np.linalg.solve(L, K).T)),
    ):  # fmt: skip
        np.testing.assert_allclose(block, expected, rtol=1e-9)
    assert problem.objective(x) < 1e-10
    assert problem.formulation.labels[:4] == ("density 1", "density 2", "ground spring", "ring spring")
    assert problem.unknowns == (("mass", 2), ("stiffness", 2), ("damping", 3))
    assert (problem.prepared.free_modes, problem.prepared.unit_mass, problem.formulation.refinable) == (
        False,
        False,
        False,
    )
    # What moves with the base at the guess, the middle of the densities.
    rigid = np.vstack([G, [[1.0]]])
    expected = rigid.T @ (5000 * forms.sum(axis=0)) @ rigid
    np.testing.assert_allclose(problem.totals, expected.ravel(), rtol=1e-12)
    # Written out it is checked, candidate by candidate.
    assert not problem.formulation.matrices.semidefinite


@pytest.mark.parametrize(
    "model", [own.CirculantStiffness((1e3, 1e6), (1e2, 1e5)), own.ComponentMass(rods(), [1e3, 2e3], [8e3, 9e3])]
)
def test_they_come_back_from_a_tree(geometry_of, model):
    back, geometry = model_from_tree(model_to_tree(model)), geometry_of(np.ones((3, 1)))
    assert type(back) is type(model)
    for made, expected in zip(back.unknowns(geometry), model.unknowns(geometry), strict=True):
        np.testing.assert_array_equal([made.lower, made.upper], [expected.lower, expected.upper])


class _Given:
    """A model of numbers, or of expressions of one unknown."""

    def __init__(self, blocks, count=1):
        self._blocks, self._count = blocks, count

    def unknowns(self, geometry):
        return (sysid.Unknown("scale", np.full(self._count, 0.5), np.full(self._count, 2.0)),) if self._count else ()

    def blocks(self, geometry, y, *before):
        return self._blocks(y)

    def values(self, geometry, structure):
        return np.ones(self._count)

    def stated(self, geometry):
        return sysid.Stated()


def problem_of(**given):
    test = sysid.simulate(structure(np.diag([1.0, 2, 3, 0]), ring(3)), np.linspace(5, 80, 40))
    return sysid.Problem(test, **{"mass": np.diag([1.0, 2, 3]), "stiffness": ring(3), "damping": [0.01] * 3, **given})


@pytest.mark.parametrize("count", [0, 1])
def test_a_model_may_give_numpy_s_arrays(count):
    """Of unknowns, or with none."""
    scaled = lambda A: lambda y: A * y[0] if count else A  # noqa: E731
    k = sysid.Variable("k", lower=0.5, upper=2.0)
    options = {} if count else {"stiffness": k * ring(3)}
    for mass in (np.diag([1.0, 2, 3]), np.diag([1.0, 2, 3, 0.5])):
        problem = problem_of(mass=_Given(scaled(mass), count), **options)
        numbers = problem.formulation.matrices.numbers(np.ones(problem.n_variables))
        np.testing.assert_allclose(numbers.mass, np.diag([1.0, 2, 3]))
        np.testing.assert_allclose(numbers.base, [[mass[3, 3] if len(mass) > 3 else 0]])
    problem = problem_of(stiffness=_Given(scaled(ring(3)), count), mass=k * np.diag([1.0, 2, 3]))
    np.testing.assert_allclose(problem.formulation.matrices.numbers(np.ones(problem.n_variables)).stiffness, ring(3))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"mass": _Given(lambda y: y[0] * np.eye(2))}, r"the mass model .* \(2, 2\); \(3, 3\) or \(4, 4\) is needed"),
        (
            {"mass": _Given(lambda y: sysid.MassBlocks(y[0] * np.eye(3), np.zeros((3, 2)), np.zeros((1, 1))))},
            r"the mass model .* \(3, 2\); \(3, 1\) is needed",
        ),
        (
            {"stiffness": _Given(lambda y: y[0] * np.ones((3, 4)))},
            r"the stiffness model .* \(3, 4\); \(3, 3\) is needed",
        ),
        ({"damping": _Given(lambda y: y[0] * np.eye(4))}, r"the damping model .* \(4, 4\); \(3, 3\) is needed"),
    ],
)
def test_a_model_that_gives_another_shape_is_refused_before_a_search(given, words):
    problem = problem_of(**given)
    with pytest.raises(sysid.InputError, match=words):
        problem.check()


class Diagonal:
    """Unknown masses in kg on the sensors, and zeros beside them."""

    def unknowns(self, geometry):
        return (sysid.Unknown("mass", np.full(geometry.n, 1.0), np.full(geometry.n, 5.0), unit="kg"),)

    def blocks(self, geometry, y):
        return ca.diag(y)

    def values(self, geometry, structure):
        return np.diag(structure.mass)[: geometry.n]

    def stated(self, geometry):
        entries = np.where(np.eye(geometry.n, geometry.n + geometry.d) > 0, np.nan, 0.0)
        return sysid.Stated(entries=entries, sentence="the mass is stated to be diagonal")


def test_masses_in_kilograms_are_not_normalised_to_one():
    """A model without a total of its own has the size of its unknowns, here that of the guess."""
    problem = problem_of(mass=Diagonal())
    assert not problem.prepared.unit_mass
    np.testing.assert_allclose(problem.totals, [9.0])
    assert problem_of(mass=sysid.LumpedMass()).prepared.unit_mass
    np.testing.assert_allclose(problem_of(mass=sysid.LumpedMass()).totals, [1.0])
