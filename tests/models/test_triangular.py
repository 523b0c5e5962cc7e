"""Entries of lower triangles stand row by row, in numbers and in expressions."""

import casadi as ca
import numpy as np

from sysid.models.expressions import lower_entries, lower_triangle, triangle, triangle_entries

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
