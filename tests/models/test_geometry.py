"""Geometry of a test: which base direction a sensor follows, and totals of the mass along each direction."""

import numpy as np
import pytest

from sysid import InputError


class TestDirections:
    def test_the_strongest_translation_the_first_on_a_tie_none_for_a_row_of_zeros(self, geometry_of):
        h = np.sqrt(0.5)
        G = [
            [0.9, 0.1, 5],
            [-0.2, -0.9, 0],
            [h, h, 0],
            [h, -h, 9],
            [0, 0, 3],
            [np.cos(np.pi / 4), np.sin(np.pi / 4), 0],
        ]
        geometry = geometry_of(G, [True, True, False])
        np.testing.assert_array_equal(geometry.directions, [0, 1, 0, 0, -1, 0, 0, 1, 2])

    @pytest.mark.parametrize("first", [0, 1])
    def test_a_tie_up_to_round_off_is_a_tie(self, geometry_of, first):
        G = np.full((1, 2), np.sqrt(0.5))
        G[0, first] *= 1 + 4e-16
        assert geometry_of(G).directions[0] == 0

    def test_a_rotation_holds_no_sensor(self, geometry_of):
        np.testing.assert_array_equal(geometry_of([[3.0, 0.1]], [False, True]).directions, [1, 0, 1])
        np.testing.assert_array_equal(geometry_of([[3.0], [1.0]], [False]).directions, [-1, -1, 0])


class TestTotals:
    def test_a_scalar_stands_for_every_translation(self, geometry_of):
        np.testing.assert_array_equal(geometry_of(np.zeros((2, 3))).totals(12.0), [12, 12, 12])

    def test_unstated_ones_are_a_kilogram_and_for_a_rotation_one_at_the_radius_of_gyration(self, geometry_of):
        """Sensors 3 and 4 m from the axis: ``1 kg * (3² + 4²) / 2 m²``."""
        np.testing.assert_allclose(geometry_of([[1.0, 3.0], [1.0, -4.0]], [True, False]).totals(None), [1.0, 12.5])

    def test_a_scalar_is_refused_where_the_base_rotates(self, geometry_of):
        with pytest.raises(InputError, match="one number but the base also rotates"):
            geometry_of(np.zeros((2, 2)), [True, False]).totals(12.0)

    @pytest.mark.parametrize("bad", [0, -1.0, [1.0, 0.0], [1.0, -2.0]])
    def test_masses_that_are_none(self, geometry_of, bad):
        with pytest.raises(InputError, match="total_mass = .* must be positive"):
            geometry_of(np.zeros((2, 2))).totals(bad)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, [1.0, np.nan]])
    def test_masses_that_are_not_finite(self, geometry_of, bad):
        with pytest.raises(InputError, match="total_mass holds NaN or infinite"):
            geometry_of(np.zeros((2, 2))).totals(bad)

    @pytest.mark.parametrize("bad", [[1.0], [1.0, 2.0, 3.0], [[1.0, 2.0]]])
    def test_number_of_totals(self, geometry_of, bad):
        with pytest.raises(InputError, match="total_mass has shape"):
            geometry_of(np.zeros((2, 2))).totals(bad)

    @pytest.mark.parametrize("bad", ["heavy", [1.0, "x"], [[1.0], [1.0, 2.0]]])
    def test_totals_that_are_no_numbers(self, geometry_of, bad):
        with pytest.raises(InputError, match="total_mass"):
            geometry_of(np.zeros((2, 2))).totals(bad)
