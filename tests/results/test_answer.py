"""Unknowns, residual and objective of an answer are the same quantities whichever way a problem is stated."""

import dataclasses
import json
import re

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.finding import Finding, Severity

MASSES, SPRINGS = np.array([2.0, 1.0]), np.array([3e4, 2e4])
STRETCH = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
M, K = np.diag([*MASSES, 0.0]), STRETCH.T @ np.diag(SPRINGS) @ STRETCH
RATIOS = np.array([0.02, 0.03])
NOT_CLOSED = (Finding("open", Severity.CAUTION, "not judged here"),)
LINES = np.linspace(5.0, 60.0, 50)


def floors(added=0.0):
    """Two floors in a chain, the second heavier by `added`."""
    return sysid.Structure(M + np.diag([0.0, added, 0.0]), K, RATIOS, n_base=1)


def measured(added=0.0, noise=0.01, **options):
    return sysid.simulate(floors(added), LINES, noise=noise, rng=1, **options)


def ended_at(problem, **values):
    """Result of `identify` where a search ends at these values of the unknowns."""
    x = np.concatenate([np.ravel(values[v.name]) for v in problem.variables])
    return stood_for(problem, problem.structure(x), x)


def stood_for(problem, structure, x):
    return sysid.Identification(structure, problem, x, "made by hand", 0, sysid.History(), NOT_CLOSED)


def springs(**options):
    return sysid.Variable("spring", 2, lower=1e4, upper=9e4, log=True, unit="N/m", **options)


def stiffness_of(k):
    return STRETCH.T @ ca.diag(k) @ STRETCH


def test_the_springs_of_a_model_are_told_like_those_of_variables():
    off = {"spring": 1.001 * SPRINGS, "damping_ratio": [0.0201, 0.0299]}
    of_model, written = (
        ended_at(sysid.Problem(measured(), mass=M, stiffness=stiffness), **off)
        for stiffness in (sysid.ChainStiffness(1e4, 9e4), stiffness_of(springs()))
    )
    figures = [json.loads(json.dumps(it.to_dict(), allow_nan=False)) for it in (of_model, written)]
    for it, one in zip((of_model, written), figures, strict=True):
        assert one["unknowns"]["spring"] == pytest.approx(1.001 * SPRINGS, rel=1e-12)
        assert one["unknowns"]["damping_ratio"] == off["damping_ratio"]
        assert one["unknown_units"] == {"spring": "N/m", "damping_ratio": ""}
        assert one["unknowns_std"]["spring"] == it.uncertainty.variables["spring"].tolist()
        assert np.all(np.array(one["unknowns_std"]["spring"]) > 0)
    np.testing.assert_allclose(*(one["unknowns_std"]["spring"] for one in figures), rtol=1e-6)
    for it, names in ((of_model, ("spring 1", "spring 2")), (written, ("spring[0]", "spring[1]"))):
        for name, value in zip(names, 1.001 * SPRINGS, strict=True):
            assert re.search(rf"^ *{re.escape(name)} +{value:.6g} +\S+ +N/m +1e\+04 to 9e\+04$", it.summary(), re.M)
        assert "damping ratio" not in it.summary()  # they stand in the table of modes


def test_entries_of_factors_and_shares_are_no_unknowns_that_are_told():
    for mass in (sysid.FullMass(3.0), sysid.LumpedMass(3.0)):
        problem = sysid.Problem(measured(), mass=mass, stiffness=sysid.SpectralStiffness(floors().natural_frequencies))
        it = stood_for(problem, floors(), problem.values(floors()))
        assert set(it.to_dict()["unknowns"]) == {"damping_ratio"}
        assert "search space" not in it.summary()
        assert set(it.values) == {v.name for v in problem.variables}  # nothing is kept back there
    weighed = sysid.Problem(measured(force=True), mass=sysid.LumpedMass(), stiffness=sysid.ChainStiffness(1e4, 9e4))
    it = stood_for(weighed, floors(), weighed.values(floors()))
    assert set(it.to_dict()["unknowns"]) == {"total_mass", "spring", "damping_ratio"}
    assert re.search(r"^ *total mass +3 .* kg ", it.summary(), re.M)


def test_fixed_variables_are_values_and_no_rows():
    m = sysid.Variable("floors", 2, lower=0.5, upper=9.0, guess=MASSES, fixed=True, unit="kg")
    problem = sysid.Problem(measured(), mass=ca.diag(m), stiffness=stiffness_of(springs()))
    it = ended_at(problem, spring=SPRINGS, damping_ratio=RATIOS)
    np.testing.assert_array_equal(it.values["floors"], MASSES)
    assert it.to_dict()["unknowns"]["floors"] == MASSES.tolist()
    assert "floors" not in it.summary()


def test_the_residual_is_that_of_all_tests_unweighted_and_the_objective_weighs_by_noise():
    own, second = measured(noise=0.01), measured(added=0.5, noise=0.03)
    c = sysid.Variable("damper", 2, lower=1.0, upper=90.0, unit="N s/m")
    k, C = springs(), stiffness_of(c)
    added = np.diag([0.0, 0.5, 0.0])
    further = sysid.FurtherTest(second, mass=M + added, stiffness=stiffness_of(k), damping=C)
    problem = sysid.Problem(own, mass=M, stiffness=stiffness_of(k), damping=C, residuals=[further])
    it = ended_at(problem, spring=1.1 * SPRINGS, damper=[20.0, 15.0])
    structures = [
        sysid.Structure(mass, STRETCH.T @ np.diag(1.1 * SPRINGS) @ STRETCH, n_base=1, damping_matrix=matrix[:2, :2])
        for mass in (M, M + added)
        for matrix in [STRETCH.T @ np.diag([20.0, 15.0]) @ STRETCH]
    ]
    left = [np.linalg.norm(t.predict(s) - t.relative) for t, s in zip((own, second), structures, strict=True)]
    sizes = [np.linalg.norm(t.relative) for t in (own, second)]
    assert it.residual == pytest.approx(np.linalg.norm(left) / np.linalg.norm(sizes), rel=1e-9)
    assert it.residuals == pytest.approx([a / b for a, b in zip(left, sizes, strict=True)], rel=1e-9)
    # One number is the noise of each test: a row of the second weighs by the ratio of both, each relative to its size.
    noise = [t.response_std.max() / size for t, size in zip((own, second), sizes, strict=True)]
    objective = np.hypot(it.residuals[0], it.residuals[1] * noise[0] / noise[1])
    assert it.objective == pytest.approx(objective, rel=1e-9)
    told = " ".join(it.summary().split())
    assert f"relative residual {it.residual:.3e} over 2 tests" in told
    assert all(f"{value:.3e}" in told for value in it.residuals)
    figures = it.to_dict()
    assert (figures["residual"], figures["objective"]) == (it.residual, it.objective)
    assert figures["residuals"] == list(it.residuals)


def test_stated_noise_and_force_move_the_objective_and_not_the_residual():
    test = measured(force=True)
    spectrum = 1.0 + 9.0 * (LINES > 30.0)  # ten times the noise in the upper lines
    stated = dataclasses.replace(test, response_std=test.response_std * spectrum)
    silent = dataclasses.replace(test, response_std=None, force_std=None)
    off = sysid.Structure(M, 1.02 * K, RATIOS, n_base=1)
    results = [stood_for(sysid.Problem(t, mass=sysid.FullMass()), off, None) for t in (test, stated, silent)]
    miss = np.linalg.norm(test.predict(off) - test.relative) / np.linalg.norm(test.relative)
    assert [it.residual for it in results] == pytest.approx([miss] * 3, rel=1e-12)
    force = np.linalg.norm(test.predict_force(off) - test.force) / np.linalg.norm(test.force)
    assert results[2].objective == pytest.approx(np.hypot(miss, force), rel=1e-9)
    weight = 1 / spectrum
    own = (test.predict(off) - test.relative) * weight / np.linalg.norm(test.relative * weight)
    scale = stated.response_std.min() / test.force_std.max() / np.linalg.norm(test.relative * weight)
    weighed = np.hypot(np.linalg.norm(own), np.linalg.norm(test.predict_force(off) - test.force) * scale)
    assert results[1].objective == pytest.approx(weighed, rel=1e-6)


def test_a_prior_of_something_else_counts_in_the_objective_of_a_modal_fit():
    test = measured()
    offset = sysid.Variable("offset", lower=0.0, upper=1.0)
    problem = sysid.Problem(test, mass=sysid.FullMass(3.0), residuals=[sysid.Prior(offset, 0.4, std=0.1)])
    assert problem.prepared.free_modes
    x = np.concatenate([problem.values(floors())[:-1], [0.6]])
    it = stood_for(problem, floors(), x)
    # Two standard deviations off, each as much as the noise of one number of the records.
    noise = test.response_std.max() / np.sqrt(2) / np.linalg.norm(test.relative)
    assert it.objective == pytest.approx(np.hypot(test.residual(floors()), 2 * noise), rel=1e-6)
    assert it.residuals == (it.residual,) == (pytest.approx(test.residual(floors()), rel=1e-6),)
    assert it.to_dict()["unknowns"]["offset"] == 0.6
    assert re.search(r"^ *offset +0\.6 ", it.summary(), re.M)
    assert "offset ends +2 standard deviations" in it.summary()


def test_where_a_misfit_of_the_users_is_fitted_alone_its_norm_is_the_residual():
    test, k = measured(), springs()
    column = k / ca.DM(SPRINGS) - 1
    problem = sysid.Problem(test, mass=M, stiffness=stiffness_of(k), misfit=column)
    it = ended_at(problem, spring=SPRINGS * [1.03, 1.04], damping_ratio=RATIOS)
    assert it.residual == pytest.approx(0.05, rel=1e-9)
    assert it.objective == pytest.approx(0.05, rel=1e-9)
    assert it.residuals == () == tuple(it.to_dict()["residuals"])


@pytest.mark.parametrize("closed", [False, True])
def test_an_open_scale_of_variables_is_one_of_many(closed):
    m = sysid.Variable("mass", 2, lower=0.5, upper=9.0, unit="kg")
    total = {"constraints": [ca.sum1(m) == 3.0]} if closed else {}
    problem = sysid.Problem(measured(), mass=ca.diag(m), stiffness=stiffness_of(springs()), **total)
    it = ended_at(problem, mass=MASSES, spring=SPRINGS, damping_ratio=RATIOS)
    assert it.is_one_of_many is not closed
    assert it.open_masses == ()
    assert it.scale_is_open is not closed
    assert "over all these models" not in it.summary()  # the rank tells of small changes only


def test_judgement_and_confidence_say_first_what_weighs_most():
    test = measured(force=True)
    found = stood_for(sysid.Problem(test, mass=sysid.FullMass()), floors(), None)
    fixed = dataclasses.replace(found, findings=()).with_findings([
        Finding("strategy", Severity.NOTE, "why"), Finding("fixed", Severity.NOTE, "force"),
        Finding("on a bound", Severity.NOTE, "a bound"),
    ])  # fmt: skip
    open_ = fixed.with_findings([Finding("open", Severity.CAUTION, "mode 2", "weigh it")])
    doubtful = open_.with_findings([Finding("gain", Severity.CONTRADICTS, "a gain is wrong")])
    failed = doubtful.with_findings([Finding("residual", Severity.CONTRADICTS, "60 % is left")])
    each = (fixed, open_, doubtful, failed)
    assert [it.judgement for it in each] == ["determined", "one of many", "doubtful", "no fit"]
    assert [it.determined for it in each] == [True, False, False, False]
    assert [it.success for it in each] == [True, True, True, False]
    assert fixed.confidence == ("force", "a bound")
    assert open_.confidence == ("mode 2; weigh it", "a bound")
    assert failed.confidence == ("a gain is wrong", "60 % is left", "mode 2; weigh it", "a bound")
    assert failed.undetermined == failed.confidence[:3] and not failed.closed_by
    assert failed.to_dict()["judgement"] == "no fit" and failed.to_dict()["confidence"] == list(failed.confidence)
