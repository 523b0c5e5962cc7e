"""The picture of a comparison shows every method that ran, its way and its end."""

import numpy as np
import pytest

import sysid
from sysid.compare.comparison import Comparison
from sysid.compare.peers import MethodResult, Status

SWARM = (("swarm", np.array([[0.1, 0.5], [1.0, 0.2]])), ("local phase", np.array([[1.1, 1e-3], [1.2, 1e-9]])))
TRUTH = sysid.Structure(np.diag([2.0, 0.5]), 4e3 * np.array([[1.0, -1.0], [-1.0, 1.0]]), [0.01], n_base=1)
PROBLEM = sysid.Problem(sysid.simulate(TRUTH, np.linspace(2.0, 20.0, 20)), mass=sysid.LumpedMass(2.0))


def drawn(*, errors=(np.nan,) * 3, widened=False):
    swarm = MethodResult("swarm", Status.FIT, "", 0.2, 1e-9, 1e-9, errors, 100, 1.25, SWARM, widened)
    refused = MethodResult("modal", Status.REFUSED, "why")
    return sysid.plot.comparison(Comparison(PROBLEM, 0, None, (swarm, refused)), "mast")


def lines(ax, style="-"):
    return [line.get_xydata() for line in ax.lines if line.get_linestyle() == style and len(line.get_xydata())]


def test_the_way_of_a_method_leads_from_its_search_through_its_local_phase_to_its_end():
    (ax,) = drawn().axes
    search, local, end = lines(ax)
    np.testing.assert_allclose(search, SWARM[0][1])
    np.testing.assert_allclose(local, np.vstack([SWARM[0][1][-1], SWARM[1][1]]))
    np.testing.assert_allclose(end, [[1.2, 1e-9], [1.25, 1e-9]])
    hollow, filled = lines(ax, "None")
    np.testing.assert_allclose([*hollow, *filled], [[1.0, 0.2], [1.25, 1e-9]])
    assert [ax.get_xscale(), ax.get_yscale()] == ["log", "log"]
    assert ax.get_ylabel().startswith("relative residual")
    words = [label for label in ax.get_legend_handles_labels()[1]]
    assert words == ["swarm", "before the local phase"]


def test_a_search_with_widened_peaks_is_dotted_and_a_straight_line_leads_to_the_end():
    (ax,) = drawn(widened=True).axes
    (search,) = lines(ax, ":")
    np.testing.assert_allclose(search, SWARM[0][1])
    (straight,) = lines(ax)
    np.testing.assert_allclose(straight, [[1.0, 0.2], [1.25, 1e-9]])


def test_errors_stand_below_where_the_truth_is_known():
    _, below = drawn(errors=(5.0, 20.0, 0.0)).axes
    points = np.vstack(lines(below, "None"))
    # What is zero stands at the foot of the logarithmic axis.
    assert points[:, 0] == pytest.approx(1.25)
    assert points[:2, 1] == pytest.approx([5.0, 20.0])
    assert 0 < points[2, 1] < 1e-10
    assert [text.get_text() for text in below.get_legend().get_texts()] == ["M", "K", "C"]
