"""A misfit that leaves the damping out: its ratios are stated or open, and are not printed as if they were found."""

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.report import opening, report
from sysid.report.opening import noise_of_test
from sysid.results.tables import quantities

STRETCH = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
M = np.diag([3.0, 2.0, 0.0])
TRUTH = sysid.Structure(M, STRETCH.T @ np.diag([900.0, 700.0]) @ STRETCH, [0.0217, 0.0319], n_base=1)
TEST = sysid.simulate(TRUTH, np.linspace(0.5, 6.0, 40), noise=0.01, rng=1)


def springs():
    k = sysid.Variable("spring", 2, lower=500.0, upper=1200.0, unit="N/m")
    return STRETCH.T @ ca.diag(k) @ STRETCH


def frequencies_alone(K):
    """Trace and determinant of M^-1 K less those of the true frequencies."""
    A, squares = ca.DM(np.diag([1 / 3, 1 / 2])) @ K[:2, :2], (2 * np.pi * TRUTH.natural_frequencies) ** 2
    return ca.vertcat(ca.trace(A) / squares.sum() - 1, ca.det(A) / squares.prod() - 1)


def factors():
    return [sysid.Variable(name, lower=0.0, upper=top) for name, top in (("alpha", 1.0), ("beta", 0.01))]


def written(K):
    alpha, beta = factors()
    return alpha * M + beta * K


LEFT_OUT = {
    "stated ratios": lambda K: [0.0217, 0.0319],
    "a stated matrix": lambda K: np.diag([0.7, 0.5]),
    "in proportion to the stiffness": lambda K: 0.0013 * K,
    "free ratios": lambda K: sysid.ModalDamping(),
    "factors of a model": lambda K: sysid.ProportionalDamping((0.0, 1.0), (0.0, 0.01)),
    "factors of its own": written,
}


@pytest.fixture
def result(request):
    K = springs()
    problem = sysid.Problem(TEST, mass=M, stiffness=K, damping=request.param(K), misfit=frequencies_alone(K))
    return sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))


@pytest.mark.parametrize("result", LEFT_OUT.values(), ids=LEFT_OUT, indirect=True)
def test_no_damping_ratio_is_told(result):
    np.testing.assert_allclose(result.structure.natural_frequencies, TRUTH.natural_frequencies, rtol=1e-6)
    percent = [f"{100 * ratio:.4g}" for ratio in result.structure.damping_ratios]
    summary, figures = result.summary(), result.to_dict()
    assert not any(one in summary for one in percent)
    (told,) = result.of_kind("no damping ratio")
    assert told.sentence in " ".join(summary.split())
    assert figures["damping_ratios"] == figures["damping_ratios_std"] == [None, None]
    assert "damping_ratio" not in figures["unknowns"]
    assert not any("damping" in name for name in quantities(result))
    assert np.all(np.isnan(result.uncertainty.damping_ratios))
    assert np.all(np.isfinite(result.uncertainty.natural_frequencies))


@pytest.mark.parametrize("result", [LEFT_OUT["stated ratios"]], indirect=True)
def test_the_page_says_so(result):
    """Its opening, and its table of modes; pictures take longest."""
    page = opening.opening(result, noise_of_test(TEST, TRUTH)) + opening.trust(result) + report._modes(result)
    (told,) = result.of_kind("no damping ratio")
    assert told.sentence[1:] in page
    assert page.count("damping not determined") == 2
    assert "damping [%]</th>" in page
    assert "2.17" not in page
    assert "3.19" not in page


def test_a_misfit_of_responses_tells_of_the_damping_that_is_unknown_in_it():
    K, (alpha, beta) = springs(), factors()
    C = alpha * M + beta * K
    response = sysid.FurtherTest(TEST, mass=M, stiffness=K, damping=C).response
    size = np.abs(TEST.response[0])
    misfit = (response.real**2 + response.imag**2) / size**2 - 1
    problem = sysid.Problem(TEST, mass=M, stiffness=K, damping=C, misfit=misfit / np.sqrt(misfit.numel()))
    assert problem.formulation.tells_damping
    result = sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))
    np.testing.assert_allclose(result.to_dict()["damping_ratios"], result.structure.damping_ratios, rtol=0)
    assert np.all(np.isfinite(result.uncertainty.damping_ratios))


def test_records_tell_of_any_damping():
    K = springs()
    further = sysid.FurtherTest(TEST, mass=M, stiffness=K, damping=0.0013 * K)
    assert sysid.Problem(TEST, mass=M, stiffness=K, damping=[0.02, 0.03]).formulation.tells_damping
    beside = sysid.Problem(
        TEST, mass=M, stiffness=K, damping=0.0013 * K, misfit=frequencies_alone(K), residuals=[further]
    )
    assert beside.formulation.tells_damping
