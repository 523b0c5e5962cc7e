"""A search that goes on from a snapshot ends with the bits of one that was never stopped."""

import json

import numpy as np
import pytest

from sysid.errors import InputError
from sysid.swarm import ParticleSwarm, minimize_swarm

BOUNDS = np.array([[-1.0, 3.0], [0.0, 10.0], [-2.0, -1.0], [5.0, 5.0]])
CENTRE = BOUNDS.mean(axis=1)


def bowl(rows):
    cost = (((rows - CENTRE) / 4) ** 2).sum(axis=1)
    return np.where(rows[:, 0] > 2.5, np.nan, cost)


WAYS = {
    "plain": {},
    "evaluations": {"max_evaluations": 333},
    "improved": {"improve": lambda x: x + 0.1 * (CENTRE - x), "improve_every": 7},
    "leaders": {"on_leader": lambda x, cost: (x + 0.2 * (CENTRE - x), 0.64 * cost)},
    "repaired": {"repair": lambda rows: np.round(rows, 2)},
    "target": {"target": 1e-3},
    "start": {"x0": CENTRE + np.array([0.5, 2.0, 0.2, 0.0])},
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("generator", [np.random.PCG64, np.random.MT19937, np.random.Philox, np.random.SFC64])
def test_from_any_iteration_the_same_bits_follow(way, generator):
    def search(callback=None, resume=None):
        rng = np.random.Generator(generator(5))
        return minimize_swarm(bowl, BOUNDS, rng=rng, max_iterations=40, callback=callback, resume=resume, **WAYS[way])

    snapshots = []
    whole = search(lambda state: snapshots.append(state.snapshot()))
    for snapshot in snapshots[:: max(len(snapshots) // 4, 1)] + snapshots[-1:]:
        again = search(resume=snapshot)
        assert again.keys() == whole.keys()
        for name, value in whole.items():
            np.testing.assert_array_equal(again[name], value, err_msg=name)


def test_a_snapshot_is_not_changed_by_what_follows():
    kept = []
    minimize_swarm(
        bowl, BOUNDS, rng=0, max_iterations=10, callback=lambda state: kept.append((state, state.snapshot()))
    )
    _, snapshot = kept[4]
    assert snapshot["swarm"]["nit"] == 5
    assert len(snapshot["swarm"]["history"]) == 5
    again = minimize_swarm(bowl, BOUNDS, rng=0, max_iterations=5)
    assert snapshot["swarm"]["best_cost"] == again.fun
    np.testing.assert_array_equal(snapshot["swarm"]["best_x"], again.x)


def test_between_ask_and_tell_the_same_rows_are_asked_for_again():
    first, second = ParticleSwarm(BOUNDS, rng=1), ParticleSwarm(BOUNDS, rng=1)
    first.tell(bowl(first.ask()))
    rows = first.ask()
    second.resume(first.to_tree())
    np.testing.assert_array_equal(second.ask(), rows)


def test_a_snapshot_of_another_search_is_refused():
    tree = ParticleSwarm(BOUNDS, rng=0).to_tree()
    for other in (ParticleSwarm(BOUNDS, n_particles=7), ParticleSwarm(BOUNDS[:3])):
        with pytest.raises(InputError, match="other particles"):
            other.resume(tree)
    twister = json.dumps({"bit_generator": "MT19937"})
    with pytest.raises(InputError, match="random source"):
        ParticleSwarm(BOUNDS, rng=0).resume({**tree, "random": twister})
