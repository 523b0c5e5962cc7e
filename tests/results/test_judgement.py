"""Judgement of where a search ended: whether noise leaves matrices known, and what rests on a bound."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.results.judgement import judge
from sysid.search.session import DeferredInterrupt, Session
from sysid.search.strategy import Outcome

FREQ = np.linspace(1.0, 12.0, 80)
BETWEEN = np.array([[1.0, -1.0], [-1.0, 1.0]])


def floors(second=2.0, dampers=(5.0, 4.0)):
    """Masses of 2 kg and `second` on equal springs to the base, a spring and a damper between them."""
    K = 800.0 * np.eye(2) + 200.0 * BETWEEN
    full = np.block([[K, -K @ np.ones((2, 1))], [-np.ones((1, 2)) @ K, np.full((1, 1), K.sum())]])
    C = dampers[0] * np.eye(2) + dampers[1] * BETWEEN
    return sysid.Structure(np.diag([2.0, second, 0.0]), full, damping_matrix=C, n_base=1)


def damped():
    """Dampers a and b, to be found."""
    a, b = (sysid.Variable(name, lower=0.1, upper=50.0, guess=4.0) for name in "ab")
    return a * np.eye(2) + b * BETWEEN


def judged(problem, **values):
    """The judgement of a search that ended at these values of the unknowns."""
    x = np.concatenate([np.ravel(values[unknown.name]) for unknown in problem.formulation.unknowns])
    end = Outcome(problem.structure(x), x, "made by hand", True, "", sysid.History())
    with DeferredInterrupt() as interrupt:
        return judge(problem, problem.prepared, end, "from the truth", 0, Session([], interrupt))


@pytest.mark.parametrize(("std", "known"), [(0.5, False), (0.02, True)])
def test_records_without_noise_know_no_more_than_the_mass_that_gives_their_scale(std, known, no_other_answers):
    """Accelerations alone: M, K and C are in proportion to a mass of 2 kg that is stated to 25 %, or to 1 %."""
    m = sysid.Variable("m", 2, lower=0.5, upper=9.0, guess=2.1)
    k = sysid.Variable("k", lower=100.0, upper=5e3, guess=820.0)
    C = damped()
    problem = sysid.Problem(
        sysid.simulate(floors(3.0), FREQ), mass=ca.diag(m), stiffness=k * (np.eye(2) + 0.25 * BETWEEN), damping=C,
        residuals=[sysid.Prior(m[0], 2.0, std)],
    )  # fmt: skip
    result = judged(problem, m=[2.0, 3.0], k=800.0, a=5.0, b=4.0)
    assert result.residual < 1e-8
    assert result.determined is known
    assert bool(result.of_kind("noise")) is not known


@pytest.mark.parametrize(("noise", "known"), [(2.0, False), (0.02, True)])
def test_records_without_noise_know_no_more_than_the_noisy_force_of_a_further_test(noise, known, no_other_answers):
    """Accelerations of both are exact; the scale of M, K and C is the force's, at 27 lines."""
    scale = sysid.Variable("scale", lower=0.1, upper=9.0, guess=1.1)
    C = damped()
    matrices = {"mass": scale * np.diag([2.0, 3.0, 0.0]), "stiffness": scale * floors(3.0).stiffness[:2, :2]}
    rng, clean = (
        np.random.default_rng(3),
        sysid.simulate(floors(3.0), FREQ[::3], force=True),
    )  # of too few lines for errors that grow with the signal
    size = noise * np.sqrt(np.mean(np.abs(clean.force) ** 2) / 2)
    off = rng.normal(size=clean.force.shape) + 1j * rng.normal(size=clean.force.shape)
    further = sysid.FurtherTest(replace(clean, force=clean.force + size * off), **matrices, damping=scale * C)
    problem = sysid.Problem(sysid.simulate(floors(3.0), FREQ), **matrices, damping=scale * C, residuals=[further])
    result = judged(problem, scale=1.0, a=5.0, b=4.0)
    assert result.residual < 1e-8
    assert result.determined is known
    assert bool(result.of_kind("noise")) is not known


@pytest.mark.parametrize(("lower", "upper"), [(100.0, 700.0), (900.0, 5e3)])
def test_an_unknown_that_rests_on_either_bound_is_told(lower, upper):
    """The spring has 800 N/m."""
    k = sysid.Variable("spring", lower=lower, upper=upper)
    C = damped()
    problem = sysid.Problem(
        sysid.simulate(floors(3.0), FREQ), mass=np.diag([2.0, 3.0]), stiffness=k * (np.eye(2) + 0.25 * BETWEEN),
        damping=C,
    )  # fmt: skip
    result = judged(problem, spring=upper if upper < 800 else lower, a=5.0, b=4.0)
    (told,) = result.of_kind("bounds", "on a bound")
    assert "spring" in told.sentence and told.numbers["unknowns"] == 1
