"""Functions of one candidate over many at once: in step where all is scalar operations, else one after the other."""

from copy import copy

import casadi as ca
import numpy as np
import pytest

from sysid.problem.batch import Batch, expanded

ROWS = np.random.default_rng(0).normal(size=(300, 3))


def scalar():
    """Constants, comparisons, a branch, a triangle of zeros and an output that is no matrix, of three numbers."""
    x = ca.SX.sym("x", 3)
    branch = ca.if_else(x[0] > 0, ca.sqrt(x[0]), x[1] ** 3)
    square = ca.vertcat(ca.horzcat(x[0], 0), ca.horzcat(x[1] / x[2], ca.fmax(x[2], 0.5)))
    return ca.Function("scalar", [x], [branch, square, ca.DM([[2.0, 0.0]]), ca.if_else(x[1] < x[2], x[0], np.nan)])


def test_each_candidate_has_the_numbers_that_it_has_alone():
    branch, square, constant, missing = Batch(scalar())(ROWS)
    a, b, c = ROWS.T
    with np.errstate(invalid="ignore"):
        np.testing.assert_allclose(branch[:, 0, 0], np.where(a > 0, np.sqrt(a), b**3), rtol=1e-14)
    np.testing.assert_allclose(
        square, np.moveaxis(np.array([[a, 0 * a], [b / c, np.maximum(c, 0.5)]]), -1, 0), rtol=1e-14
    )
    np.testing.assert_array_equal(constant, np.broadcast_to([[2.0, 0.0]], (300, 1, 2)))
    np.testing.assert_array_equal(missing[:, 0, 0], np.where(b < c, a, np.nan))


@pytest.mark.parametrize("count", [1, 5, 64, 127, 128, 129])
def test_no_bit_depends_on_how_many_there_are_nor_on_the_order(count):
    batch, order = Batch(scalar()), np.random.default_rng(1).permutation(len(ROWS))
    for made, expected, turned in zip(batch(ROWS[:count]), batch(ROWS), batch(ROWS[order]), strict=True):
        np.testing.assert_array_equal(made, expected[:count])
        np.testing.assert_array_equal(turned, expected[order])


def test_inputs_of_any_shape_stand_as_they_are_given():
    A, v = ca.SX.sym("A", 2, 3), ca.SX.sym("v", 3)
    rng = np.random.default_rng(0)
    matrices, vectors = rng.normal(size=(70, 2, 3)), rng.normal(size=(70, 3))
    for function in (ca.Function("f", [A, v], [A @ v, A.T]), ca.Function("f", [A, v], [A @ v, A.T]).wrap()):
        product, transposed = Batch(function)(matrices, vectors)
        np.testing.assert_allclose(product[..., 0], np.einsum("pij,pj->pi", matrices, vectors), rtol=1e-13)
        np.testing.assert_array_equal(transposed, matrices.swapaxes(1, 2))


def test_a_copy_has_memory_of_its_own():
    batch = Batch(scalar())
    expected = batch(ROWS[:3])
    copy(batch)(ROWS[100:])
    for made, before in zip([np.array(place[:3]) for place in batch._results], expected, strict=True):
        np.testing.assert_array_equal(made, before)


def test_what_has_no_scalar_form_is_called_for_one_after_the_other():
    x = ca.MX.sym("x", 3)
    held = ca.Function("held", [x], [ca.sin(x)], {"never_inline": True})
    table = ca.interpolant("table", "linear", [[-9.0, 0.0, 9.0]], [-18.0, 0.0, 18.0])
    for expression in (held(x), ca.vertcat(*(table(part) for part in ca.vertsplit(x)))):
        function = expanded(ca.Function("f", [x], [2 * expression]))
        expected = [np.asarray(function(row)).ravel() for row in ROWS]
        np.testing.assert_array_equal(Batch(function)(ROWS)[0][..., 0], expected)
