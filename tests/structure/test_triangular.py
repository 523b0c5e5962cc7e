"""Entries of lower triangles stand row by row, in numbers and in expressions; inverses of many triangles at once."""

import casadi as ca
import numpy as np

from sysid.structure.triangular import inverse_triangles, lower_entries, lower_triangle, triangle, triangle_entries

WHOLE = np.array([[1.0, 20.0, 30.0], [2.0, 3.0, 40.0], [4.0, 5.0, 6.0]])


def test_entries_are_those_of_the_lower_triangle_row_by_row():
    np.testing.assert_array_equal(triangle_entries(WHOLE), [1, 2, 3, 4, 5, 6])
    for kind in (ca.MX, ca.SX):
        made = ca.evalf(lower_entries(kind(ca.DM(WHOLE))))
        np.testing.assert_array_equal(np.asarray(made).ravel(), [1, 2, 3, 4, 5, 6])


def test_triangles_have_zeros_above():
    expected = [[1, 0, 0], [2, 3, 0], [4, 5, 6]]
    np.testing.assert_array_equal(triangle(np.arange(1.0, 7), 3), expected)
    made = ca.evalf(ca.densify(lower_triangle(ca.MX(ca.DM(np.arange(1.0, 7))), 3)))
    np.testing.assert_array_equal(np.asarray(made), expected)


def test_inverses_of_triangles_side_by_side():
    stack = np.tril(np.random.default_rng(0).normal(size=(5, 4, 4))) + 2 * np.eye(4)
    made = inverse_triangles(np.moveaxis(stack, 0, -1))
    np.testing.assert_allclose(np.moveaxis(made, -1, 0), np.linalg.inv(stack), rtol=1e-12, atol=1e-12)
