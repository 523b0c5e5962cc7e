"""The same seed gives the same bits: repeated, copied, pickled, interrupted."""

import copy
import pickle

import numpy as np
import pytest

from sysid.swarm import ParticleSwarm

BOUNDS = np.array([[-1.0, 3.0], [0.0, 10.0], [-2.0, -1.0], [5.0, 5.5]])
CENTRE = BOUNDS.mean(axis=1)


def bowl(rows):
    return (((rows - CENTRE) / 4) ** 2).sum(axis=1)


def run(swarm, iterations):
    for _ in range(iterations):
        swarm.tell(bowl(swarm.ask()))
    return swarm


def test_a_seed_gives_the_same_bits_and_another_seed_others():
    first, again, other = (run(ParticleSwarm(BOUNDS, rng=seed), 30) for seed in (11, 11, 12))
    np.testing.assert_array_equal(first.positions, again.positions)
    assert first.history == again.history
    assert first.history != other.history


def test_equal_generators_give_equal_bits_wherever_they_stand_in_their_stream():
    generator = np.random.default_rng(1)
    generator.random(17)
    state = generator.bit_generator.state
    first = run(ParticleSwarm(BOUNDS, rng=generator), 20)
    generator.bit_generator.state = state
    assert run(ParticleSwarm(BOUNDS, rng=generator), 20).history == first.history


def test_a_seed_sequence_is_a_seed():
    first, again = (run(ParticleSwarm(BOUNDS, rng=np.random.SeedSequence(3).spawn(2)[1]), 10) for _ in range(2))
    assert first.history == again.history


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda swarm: pickle.loads(pickle.dumps(swarm))])
@pytest.mark.parametrize("asked", [False, True])
def test_a_copy_made_mid_run_goes_on_with_the_same_bits(duplicate, asked):
    swarm = run(ParticleSwarm(BOUNDS, rng=13), 15)
    if asked:
        swarm.ask()
    twin = duplicate(swarm)
    for _ in range(20):
        np.testing.assert_array_equal(twin.ask(), swarm.ask())
        swarm.tell(bowl(swarm.ask()))
        twin.tell(bowl(twin.ask()))
    np.testing.assert_array_equal(twin.best_x, swarm.best_x)
    assert twin.state_counts == swarm.state_counts


def test_an_interrupted_evaluation_leaves_the_swarm_untouched():
    disturbed, quiet = run(ParticleSwarm(BOUNDS, rng=1), 10), run(ParticleSwarm(BOUNDS, rng=1), 10)

    def interrupted(rows):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        disturbed.tell(interrupted(disturbed.ask()))
    assert disturbed.best_cost == quiet.best_cost
    assert run(disturbed, 10).history == run(quiet, 10).history
