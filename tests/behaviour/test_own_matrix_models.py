"""Matrix models that are not of the package go through all of it: what the same problem written in variables gives."""

import importlib
from pathlib import Path

import numpy as np
import pytest

import sysid
from sysid.cli.show import show
from sysid.report import report
from sysid.search import local

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")


with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(str(Path(__file__).parents[1] / "models"))
    own = importlib.import_module("own_models")

N = 4
VOLUMES, OF = np.array([1.0, 1.3, 0.8, 1.1]) * 1e-3, np.array([0, 0, 1, 1])  # m³, and each sector's component
DENSITIES, GROUND, RING = np.array([2700.0, 7800.0]), 4e5, np.array([1.2e5, 3e4])
RATIOS = np.array([0.01, 0.012, 0.015, 0.02])
FREQ = np.linspace(40.0, 140.0, 120)
LOWER, UPPER = [1000.0, 1000.0], [12e3, 12e3]
GROUND_RANGE, RING_RANGE = (1e5, 2e6), (5e3, 5e5)
UNKNOWNS = ("density", "ground_spring", "ring_spring")
LINES = ("density 1", "density 2", "ground spring", "ring spring 1", "ring spring 2")


def forms():
    """Rods from the base to each sector, by component, with a lump on each sector: mass for unit density."""
    made = np.zeros((2, N + 1, N + 1))
    for i, (v, c) in enumerate(zip(VOLUMES, OF, strict=True)):
        made[c, i, i] = v / 3 + 2e-4
        made[c, i, N] = made[c, N, i] = v / 6
        made[c, N, N] += v / 3
    return made


def neighbours(distance):
    turned = np.roll(np.eye(N), distance, axis=0)
    return 2 * np.eye(N) - turned - turned.T


def truth():
    K = GROUND * np.eye(N) + RING[0] * neighbours(1) + RING[1] * neighbours(2)
    one = np.ones((N, 1))
    whole = np.block([[K, -K @ one], [-one.T @ K, one.T @ K @ one]])
    return sysid.Structure(np.tensordot(DENSITIES, forms(), 1), whole, RATIOS, n_base=1)


def measured(noise=0.0, force=True):
    return sysid.simulate(truth(), FREQ, noise=noise, force=force, rng=0)


def by_models(test, **given):
    mass = own.ComponentMass(forms(), LOWER, UPPER)
    return sysid.Problem(test, mass=mass, stiffness=own.CirculantStiffness(GROUND_RANGE, RING_RANGE), **given)


def by_hand(test):
    density = sysid.Variable("density", 2, lower=LOWER, upper=UPPER)
    ground = sysid.Variable("ground_spring", 1, lower=GROUND_RANGE[0], upper=GROUND_RANGE[1])
    ring = sysid.Variable("ring_spring", 2, lower=RING_RANGE[0], upper=RING_RANGE[1])
    ratio = sysid.Variable("damping_ratio", N, lower=0.005, upper=0.05)
    return sysid.Problem(
        test, mass=sum(density[i] * form for i, form in enumerate(forms())), damping=ratio,
        stiffness=ground * np.eye(N) + ring[0] * neighbours(1) + ring[1] * neighbours(2),
    )  # fmt: skip


@pytest.fixture(scope="module")
def noisy():
    """By models, and by hand: the same test, strategy and seed."""
    test, once = measured(noise=0.01), sysid.Continuation(starts=1)
    return [sysid.identify(make(test), rng=0, strategy=once) for make in (by_models, by_hand)]


def test_show_lists_their_unknowns_and_what_the_records_see():
    text = show(by_models(measured(noise=0.01), reference=truth()), "ring")
    table = [line.split() for line in text.splitlines()]
    assert ["mass", "2", "density", "(2)"] in table
    assert ["stiffness", "3", "ground", "spring", "(1),", "ring", "spring", "(2)"] in table
    assert any(line[:1] == ["density"] and "kg/m³" in line and "ComponentMass" in line for line in table)
    assert "9 of the 9 directions" in text


@pytest.mark.parametrize("strategy", ["auto", sysid.Swarm(max_iterations=15)], ids=["auto", "swarm"])
def test_every_strategy_that_applies_finds_the_truth(strategy):
    result = sysid.identify(by_models(measured()), rng=0, strategy=strategy)
    assert result.success
    assert result.strategy == ("swarm" if isinstance(strategy, sysid.Swarm) else "continuation")
    assert result.residual < 1e-6
    np.testing.assert_allclose(result.values["density"], DENSITIES, rtol=1e-5)
    np.testing.assert_allclose(result.values["ground_spring"], GROUND, rtol=1e-5)
    np.testing.assert_allclose(result.values["ring_spring"], RING, rtol=1e-5)
    np.testing.assert_allclose(result.values["damping_ratio"], RATIOS, rtol=1e-5)
    assert result.determined, result.undetermined


def test_the_modal_strategy_says_why_it_does_not_apply():
    with pytest.raises(sysid.InputError, match=r"(?i)stiffness"):
        sysid.identify(by_models(measured()), strategy="modal")


def test_the_local_phase_ends_at_the_truth_from_nearby():
    problem = by_models(measured())
    x = problem.values(truth())
    answer = local.solve(problem.prepared, x * np.linspace(0.97, 1.03, x.size))
    assert answer.success
    np.testing.assert_allclose(answer.x, x, rtol=1e-6)


def test_a_start_may_be_a_structure():
    result = sysid.identify(by_models(measured()), rng=0, start=truth(), strategy=sysid.Continuation(starts=1))
    assert result.residual < 1e-7
    other = sysid.Structure(truth().mass + np.diag([1.0, 0, 0, 0, 0]), truth().stiffness, RATIOS, n_base=1)
    with pytest.raises(sysid.InputError, match="not made of these components"):
        sysid.identify(by_models(measured()), start=other)


def test_noise_is_answered_as_in_the_problem_written_by_hand(noisy):
    models, hand = noisy
    for name in (*UNKNOWNS, "damping_ratio"):
        np.testing.assert_allclose(models.values[name], hand.values[name], rtol=1e-5, err_msg=name)
        std, expected = models.uncertainty.variables[name], hand.uncertainty.variables[name]
        np.testing.assert_allclose(std, expected, rtol=1e-4, err_msg=name)
        assert np.all(std > 0)
    for name in ("mass", "stiffness"):
        made, expected = getattr(models.structure, name), getattr(hand.structure, name)
        np.testing.assert_allclose(made, expected, rtol=1e-5, atol=1e-6 * np.abs(expected).max())
    assert models.residual == pytest.approx(hand.residual, rel=1e-6)
    assert models.determined == hand.determined
    # The truth is where noise leaves it.
    for name, true in zip(UNKNOWNS, (DENSITIES, GROUND, RING), strict=True):
        assert np.all(np.abs(models.values[name] - true) < 4 * models.uncertainty.variables[name])


def test_without_a_force_one_scale_is_open_and_it_is_said():
    """Densities and springs grow together without any record seeing it."""
    result = sysid.identify(by_models(measured(force=False)), rng=0, strategy=sysid.Continuation(starts=1))
    assert result.residual < 1e-6
    assert not result.determined
    assert any("density" in sentence and "spring" in sentence for sentence in result.undetermined)
    ratio = result.values["density"] / DENSITIES
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-4)
    np.testing.assert_allclose(result.values["ring_spring"] / RING, ratio[0], rtol=1e-4)
    # Their shapes and frequencies are known all the same.
    np.testing.assert_allclose(result.structure.natural_frequencies, truth().natural_frequencies, rtol=1e-6)


def test_a_prior_of_a_variable_that_enters_no_matrix_stands_apart():
    u = sysid.Variable("other", lower=0.0, upper=2.0)
    problem = by_models(measured(), residuals=[sysid.Prior(u, 1.2, 0.1)])
    result = sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))
    np.testing.assert_allclose(result.values["other"], 1.2, atol=1e-3 * 0.1)
    np.testing.assert_allclose(result.uncertainty.variables["other"], 0.1, rtol=1e-3)
    np.testing.assert_allclose(result.values["density"], DENSITIES, rtol=1e-5)


def test_the_summary_and_the_report_have_their_unknowns(noisy, tmp_path, no_pictures):
    result = noisy[0]
    summary = result.summary()
    page = report.write_report(result, tmp_path / "report.html").read_text(encoding="utf-8")
    for line in LINES:
        assert line in summary
        assert line in page
    for sentence in result.closed_by:
        assert sentence in summary


def test_they_are_stored_and_come_back(noisy, tmp_path):
    result = noisy[0]
    again = sysid.load(result.save(tmp_path / "ring"))
    assert type(again.problem.mass) is own.ComponentMass
    assert type(again.problem.stiffness) is own.CirculantStiffness
    x = result.problem.values(result.structure)
    np.testing.assert_array_equal(again.problem.structure(x).mass, result.problem.structure(x).mass)
    np.testing.assert_array_equal(again.problem.structure(x).stiffness, result.problem.structure(x).stiffness)
    assert again.problem.objective(x) == pytest.approx(result.problem.objective(x), rel=1e-12)
    for name in (*UNKNOWNS, "damping_ratio"):
        np.testing.assert_array_equal(again.values[name], result.values[name])
        made, expected = again.uncertainty.variables[name], result.uncertainty.variables[name]
        np.testing.assert_allclose(made, expected, rtol=1e-9)
    assert again.summary() == result.summary()
