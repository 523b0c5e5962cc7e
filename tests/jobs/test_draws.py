"""Draws of noise: records as the structure would have given them, and their spread beside the linear one."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.jobs import JobResult, processes, spreads, submit
from sysid.jobs.changes import drawn

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
MODULE = '''"""Two floors, recorded with noise."""

import casadi as ca
import numpy as np

import sysid


def problem(*, data=None, rng=0, noise=0.02):
    stretch = np.array([[1.0, 0, -1], [-1, 1, 0]])
    M, C = np.diag([300.0, 200.0, 0.0]), stretch.T @ np.diag([900.0, 700.0]) @ stretch
    truth = sysid.Structure(M, stretch.T @ np.diag([3e5, 2e5]) @ stretch, damping_matrix=C[:2, :2], n_base=1)
    k = sysid.Variable("spring", 2, lower=1e4, upper=1e6, log=True)
    test = sysid.simulate(truth, np.linspace(0.5, 10, 60), noise=noise, rng=7)
    return sysid.Problem(test, mass=M, stiffness=stretch.T @ ca.diag(k) @ stretch, damping=C)
'''


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    file = tmp_path_factory.mktemp("draws") / "floors.py"
    file.write_text(MODULE)
    return sysid.Recipe(str(file))


@pytest.fixture(scope="module")
def result(recipe):
    return sysid.identify(sysid.catalogue.build(recipe), rng=0)


def test_noise_has_the_stated_size_about_what_the_structure_predicts(result):
    """Its square over the stated one's is a chi-squared number: 2 a line and sensor."""
    problem, x = result.problem, result.x
    test, left = problem.measurement, []
    predicted = test.response - test.relative + test.predict(problem.structure(x))
    for seed in range(20):
        noise = drawn(problem.prepared, x, np.random.SeedSequence(seed)).measurement.response - predicted
        left.append(np.sum(np.abs(noise / test.response_std) ** 2))
    freedom = test.response.size  # of |e|²/std², whose mean is 1 and variance 1
    assert abs(np.mean(left) - freedom) < 4 * np.sqrt(freedom / 20)
    assert len(set(left)) == 20


def test_noise_that_is_not_stated_has_the_size_of_the_misfit(result):
    test = replace(result.problem.measurement, response_std=None)
    problem = replace(result.problem, measurement=test)
    again = drawn(problem.prepared, result.x, np.random.SeedSequence(0)).measurement
    misfit = np.linalg.norm(test.relative - test.predict(result.structure))
    noise = np.linalg.norm(again.relative - again.predict(result.structure))
    assert noise == pytest.approx(misfit, rel=4 / np.sqrt(2 * test.response.size))


def test_further_tests_and_values_known_to_some_accuracy_are_drawn_too(result):
    k, test = sysid.Variable("k", lower=1.0, upper=9.0), result.problem.measurement
    M, C = np.diag([300.0, 200.0]), np.diag([900.0, 700.0])
    K = [[k * 1e5, -1e5], [-1e5, 1e5]]
    known = sysid.Prior(k, 4.0, std=0.5)
    further = sysid.FurtherTest(test, mass=M, stiffness=K, damping=C)
    problem = sysid.Problem(test, mass=M, stiffness=K, damping=C, residuals=[known, further], goal=0.3)
    draws = [drawn(problem.prepared, np.array([5.0]), np.random.SeedSequence(seed)) for seed in range(100)]
    values = [draw.residuals[0].value.item() for draw in draws]
    assert np.mean(values) == pytest.approx(5.0, abs=2.8 * 0.5 / np.sqrt(100))
    assert np.std(values) == pytest.approx(0.5, rel=2.8 / np.sqrt(200))
    first, second = (draw.residuals[1].measurement.response for draw in draws[:2])
    assert not np.array_equal(first, second)
    assert not np.array_equal(first, draws[0].measurement.response)  # one noise each


@pytest.mark.parametrize("own", ["misfit", "residuals"])
def test_what_has_no_known_noise_cannot_be_drawn(result, own):
    k = sysid.Variable("k", lower=1.0, upper=9.0)
    stated = {"misfit": k - 3.0} if own == "misfit" else {"residuals": [k - 3.0]}
    problem = replace(result.problem, stiffness=np.eye(2) * ca.MX(1e5) * k, **stated)
    with pytest.raises(sysid.InputError, match="draws of noise need records"):
        drawn(problem.prepared, np.array([3.0]), np.random.SeedSequence(0))


def test_noise_is_raised_as_the_linear_uncertainty_is_where_it_is_stated_too_small(result):
    """A quarter of the true one: the misfit shows it, and both deviations allow for it."""
    test = result.problem.measurement
    small = replace(result.problem, measurement=replace(test, response_std=test.response_std / 4))
    assert sysid.identify(small, rng=0).uncertainty.inflation == pytest.approx(4, rel=0.15)
    predicted = test.response - test.relative + test.predict(result.structure)
    noise = drawn(small.prepared, result.x, np.random.SeedSequence(0)).measurement.response - predicted
    assert np.sqrt(np.mean(np.abs(noise / test.response_std) ** 2)) == pytest.approx(1, rel=0.2)


def test_the_spread_of_draws_is_the_linear_one_and_their_bits_are_the_same_everywhere(recipe, result):
    """Springs of a test with 2 % noise: 40 draws tell a standard deviation to 11 %."""
    start = replace(recipe, start=result.x)
    here = list(submit(start, draws=40))
    assert len({end.seed for end in here}) == 40
    there = sorted(submit(start, draws=8, executor=processes(2)), key=lambda end: end.index)
    assert [end.x.tobytes() for end in there] == [end.x.tobytes() for end in here[:8]]
    found = {spread.name: spread for spread in spreads(result, here)}
    assert list(found)[-2:] == ["spring 1", "spring 2"]
    for name in ("spring 1", "spring 2", "mode 1: frequency, Hz", "mode 2: damping ratio"):
        assert found[name].drawn / found[name].std == pytest.approx(1, abs=0.4)
        assert found[name].inside > 0.8


def test_spreads_are_root_mean_squares_about_the_answer(result):
    """Draws at 1 and 3 standard deviations of the first spring: root of 5, one of two inside."""
    std = result.uncertainty.variables["spring"][0]
    ends = [JobResult(i, 0, True, "", result.x + np.array([times * std, 0.0]), 0.01) for i, times in enumerate((-1, 3))]
    ends.append(JobResult(2, 0, False, "no fit", np.zeros(0), np.nan))
    one, other = spreads(result, ends)[-2:]
    assert (one.name, one.value, one.inside) == ("spring 1", pytest.approx(result.x[0]), 0.5)
    assert one.drawn == pytest.approx(np.sqrt(5) * one.std, rel=1e-6)
    assert (other.drawn, other.inside) == (0.0, 1.0)
    with pytest.raises(sysid.InputError, match="1 of 2 draws have a result"):
        spreads(result, ends[1:])


@pytest.mark.parametrize(
    ("given", "told"),
    [(dict(draws=-1), "draws"), (dict(draws=3), "draws need Recipe.start"), (dict(draws=True), "draws")],
)
def test_mistakes_are_told_before_any_job(recipe, given, told):
    with pytest.raises(sysid.InputError, match=told):
        submit(recipe, **given)


def test_hubers_loss_is_that_of_every_job(tmp_path):
    """Jobs end where the identification did; drawn noise has no spikes, and scatters as the uncertainty says."""
    spikes = "    test.response[0, :, [11, 37]] += 60 * test.response_std[0, 0, 0]\n    return"
    text = MODULE.replace("    return", spikes).replace("damping=C)", "damping=C, loss='huber')")
    file = tmp_path / "spikes.py"
    file.write_text(text)
    recipe = sysid.Recipe(str(file))
    problem = sysid.catalogue.build(recipe)
    result = sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))
    std = result.uncertainty.variables["spring"]
    begun = replace(recipe, start=tuple(1.0002 * result.x))
    (end,) = submit(begun)
    assert end.success
    np.testing.assert_array_less(np.abs(end.x - result.x), 1e-2 * std)
    ends = list(submit(replace(recipe, start=tuple(result.x)), draws=6))
    drawn_std = np.sqrt(np.mean([(one.x - result.x) ** 2 for one in ends], axis=0))
    assert np.all((drawn_std > 0.4 * std) & (drawn_std < 1.8 * std))
