"""Strategy "swarm" as the paper has it: its defaults, and the refinement of the swarm's best by IPOPT."""

import numpy as np
import pytest

import sysid


@pytest.fixture
def problem(random_case):
    return random_case(np.random.default_rng(0), "rigid_body", n=3, d=1)[1]


def test_the_defaults():
    """Velocities up to 0.4 of the range and 5 particles an unknown, which None stands for, are the paper's (3.3.1)."""
    strategy = sysid.Swarm()
    assert strategy.n_particles is None
    assert strategy.settings.max_velocity == 0.4
    assert strategy.max_iterations == 150


def test_a_search_with_the_defaults_has_five_particles_an_unknown_and_up_to_150_iterations(problem):
    seen = []

    def stop(progress):
        seen.append(progress)
        if progress.iteration == 2:
            raise StopIteration

    result = sysid.identify(problem, strategy="swarm", rng=0, callback=stop)
    assert [(progress.phase, progress.of) for progress in seen] == [("swarm", 150)] * 2
    rows = 5 * result.x.size
    assert result.history.evaluations in (2 * rows, 2 * rows + 1)  # elitist learning adds one


def test_the_refinement_by_ipopt_is_taken_where_its_residual_is_lower(problem):
    """The swarm's best has its cost with the closed form."""
    gains = []
    for seed in range(6):
        quick = sysid.Swarm(max_iterations=5, n_particles=20, local=None)
        result = sysid.identify(problem, strategy=quick, rng=seed)
        history = result.history
        assert result.residual == pytest.approx(history.refinement, rel=1e-9)
        np.testing.assert_allclose(
            result.structure.natural_frequencies, problem.reference.natural_frequencies, rtol=1e-8
        )
        gains.append(1 - history.refinement / history.swarm)
    assert min(gains) > -1e-9
    assert max(gains) > 1e-2
