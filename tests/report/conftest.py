"""Fixtures of tests of the report: two results and a page."""

import dataclasses

import numpy as np
import pytest

import sysid
from sysid.finding import Finding, Severity
from sysid.report import report

FREQ = np.linspace(1.0, 40.0, 30)


@pytest.fixture(scope="session")
def hostile():
    """Give a name of a sensor that would run a script if it were not escaped."""
    return "</td><script>alert('x')</script> & \"$\\foo$\""


@pytest.fixture(scope="session")
def truth(random_structure):
    return random_structure(np.random.default_rng(8), 3, 2, G=np.array([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]))


@pytest.fixture(scope="session")
def complete(truth, hostile):
    """Unit runs with force, reference and a validation of two runs in which everything moves."""
    random = np.random.default_rng(4)
    guess = sysid.Structure(truth.mass, 1.02 * truth.stiffness, truth.damping_ratios, n_base=2)
    names = ("low", hostile, "tip")
    axes = ("x", (0.6, 0.8, 0.0), "y")
    sensors = [sysid.Sensor(name, (0, 0, i), axis) for i, (name, axis) in enumerate(zip(names, axes, strict=True))]
    test = dataclasses.replace(sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=3), sensors=sensors)
    base = random.standard_normal((2, 2, FREQ.size)) + 1j * random.standard_normal((2, 2, FREQ.size))
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(FREQ), base)
    unseen = sysid.Measurement(FREQ, base, response, rigid_body=truth.rigid_body, sensors=sensors)
    problem = sysid.Problem(
        test,
        mass=sysid.FullMass(np.diag(truth.rigid_body_mass)),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
        reference=truth,
        validation=[unseen],
        goal=0.5,
    )
    history = sysid.History(
        start=0.9,
        swarm=0.5,
        local=0.01,
        swarm_curve=np.array([0.9, 0.5]),
        local_curve=np.array([0.4, 0.01]),
        refinement_error=1e-11,
        leaders_tried=12,
        leaders_won=5,
        refinement_statuses=(("Restoration_Failed", 1), ("Solve_Succeeded", 11)),
        states=(("exploration", 7),),
        evaluations=777,
        wall_time=1.5,
        log=("0.00 s  swarm over 27 unknowns", "<b>done</b>"),
    )
    return sysid.Identification(
        guess, problem, problem.values(guess), "swarm", 42, history,
        (
            Finding("open", Severity.CAUTION, "the mass of mode 3 is open"),
            Finding("fixed", Severity.NOTE, "the force weighs 2 modes"),
            Finding("strategy", Severity.NOTE, "strategy 'swarm', as asked"),
            Finding("ending", Severity.NOTE, "Solve_Succeeded; damping_ratio[1] ends on its bound"),
        ),
        recipe=sysid.Recipe("problems/tower.py", "data/x", 1),
    )  # fmt: skip


@pytest.fixture(scope="session")
def page(complete):
    """The page of `complete`: it takes seconds."""
    return report.render(complete)


@pytest.fixture
def plain(truth):
    """No reference, no validation, no force, no names, no search, no unit of mass."""
    problem = sysid.Problem(
        sysid.simulate(truth, FREQ),
        mass=sysid.FullMass(),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
    )
    return sysid.Identification(
        truth, problem, problem.values(truth), "swarm", None, sysid.History(),
        (
            Finding("stopped", Severity.CONTRADICTS, "the search ended before it found a fit (interrupted)"),
            Finding("fixed", Severity.NOTE, "the mass matrix is known"),
            Finding("ending", Severity.NOTE, "interrupted"),
        ),
        interrupted=True,
    )  # fmt: skip
