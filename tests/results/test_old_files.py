"""Results that an earlier version wrote (formats 1 and 2) are read as they were; stored/make.py made them."""

import json
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
import pytest

import sysid

STORED = Path(__file__).with_name("stored")
EXPECTED = json.loads((STORED / "expected.json").read_text(encoding="utf-8"))
NAMES = list(EXPECTED)
IN_MODELS = [name for name in NAMES if EXPECTED[name]["format"] == 1]


@pytest.fixture(scope="module", params=NAMES)
def pair(request):
    """A loaded result, and what was in it before it was stored."""
    return sysid.load(STORED / f"{request.param}.h5"), EXPECTED[request.param]


def objective(it):
    """Root of the sum of all that is minimised."""
    return it.problem.objective(it.x)


def assert_same(actual, expected, at, rtol=0.0, atol=0.0):
    """Compare with JSON: a dictionary by attributes or keys, numbers exactly or within tolerances, NaN as a text."""
    if isinstance(expected, dict):
        for key, part in expected.items():
            child = actual[key] if isinstance(actual, Mapping) else getattr(actual, key)
            assert_same(child, part, f"{at}.{key}", rtol, atol)
    elif expected is None or isinstance(expected, bool | int) or isinstance(actual, str):
        assert actual == expected and type(actual) is type(expected), at
    elif isinstance(expected, list) and not is_numeric(expected):
        assert len(actual) == len(expected), at
        for i, (mine, other) in enumerate(zip(actual, expected, strict=True)):
            assert_same(mine, other, f"{at}[{i}]", rtol, atol)
    else:
        numbers, others = np.asarray(actual, dtype=float), np.array(expected, dtype=float)
        assert numbers.shape == others.shape, at
        np.testing.assert_allclose(numbers, others, rtol=rtol, atol=atol, err_msg=at)


def is_numeric(values):
    """Whether nested lists hold numbers only, NaN and infinity as texts included; empty ones do not."""
    try:
        return np.array(values, dtype=float).size > 0
    except (TypeError, ValueError):
        return False


def assert_stored(actual, stored):
    """All that was stored, to the last bits of what is computed from it, which processors round in their own ways."""
    assert_same(actual, stored, "result", rtol=1e-13, atol=1e-13)


def test_the_files_have_the_old_formats(pair):
    _, expected = pair
    name = next(name for name in NAMES if EXPECTED[name] is expected)
    with h5py.File(STORED / f"{name}.h5") as file:
        assert int(file.attrs["format"]) == expected["format"]


def test_all_that_was_stored_is_the_same(pair):
    it, expected = pair
    assert_stored(it, expected["stored"])
    for name, kind in expected["models"].items():
        assert type(getattr(it.problem, name)).__name__ == kind


def test_what_follows_from_it_is_the_same(pair):
    it, expected = pair
    computed = dict(expected["computed"])
    # The residual was that of the first test; it is that of all fitted tests together.
    first = it.residuals[0] if it.residuals else it.residual
    assert first == pytest.approx(computed.pop("residual"), rel=1e-9, abs=1e-13)
    assert_same(it, computed, "result", rtol=1e-9, atol=1e-13)
    if expected["objective"] is not None:  # residuals, further tests and what is known count in it
        assert objective(it) == pytest.approx(expected["objective"], rel=1e-9)


def test_the_unknowns_still_stand_for_the_structure(pair):
    it, _ = pair
    if it.x is None:
        assert it.values == {}
        return
    structure = it.problem.structure(it.x)
    for name in ("mass", "stiffness", "damping"):
        expected = getattr(it.structure, name)
        np.testing.assert_allclose(getattr(structure, name), expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max())


@pytest.mark.parametrize("name", IN_MODELS)
def test_values_of_models_are_the_unknowns(name):
    it = sysid.load(STORED / f"{name}.h5")
    if it.x is not None:
        assert sum(np.size(value) for value in it.values.values()) == it.x.size


def test_predictions_leave_the_residual(pair):
    it, _ = pair
    test = it.measurement
    left = np.linalg.norm(it.predict(test) - test.relative) / np.linalg.norm(test.relative)
    assert left == pytest.approx(test.residual(it.structure), rel=1e-9, abs=1e-13)
    for other in it.problem.validation:
        assert it.predict(other).shape == other.response.shape


def test_the_summary_tells_frequencies_and_sentences(pair):
    it, _ = pair
    text = " ".join(it.summary().split())
    for frequency in it.structure.natural_frequencies:
        assert f"{frequency:.5g}" in text
    for sentence in (*it.closed_by, *it.undetermined):
        assert " ".join(sentence.split()) in text


def test_standard_deviations_are_the_same(pair):
    it, expected = pair
    if it.residual > 1e-9:  # else they are round-off
        for name, std in expected["uncertainty"].items():
            if name != "variables":
                # A deviation of a stated entry is zero, or the round-off of one.
                value = np.abs(np.asarray(getattr(it.structure, name, 0.0), dtype=float)).max(initial=0.0)
                atol = 1e-9 * largest(std) + 1e-15 * value
                assert_same(getattr(it.uncertainty, name), std, name, rtol=1e-6, atol=atol)
        assert_same(it.uncertainty.variables, expected["uncertainty"]["variables"], "variables", rtol=1e-6, atol=1e-12)
    assert it.uncertainty.mass.shape == (it.structure.n, it.structure.n)


def largest(numbers):
    return np.nanmax(np.abs(np.array(numbers, dtype=float)), initial=0.0)


def test_constraints_and_all_residuals_still_act():
    it = sysid.load(STORED / "expressions.h5")
    again = sysid.identify(it.problem, rng=0, start=it.x, strategy=sysid.Continuation(starts=1))
    assert again.values["m"].sum() == pytest.approx(5.02, rel=1e-9)  # the masses behind the records have 5.0
    np.testing.assert_allclose(again.x, it.x, rtol=1e-5)


def test_healing_still_acts():
    """The sum of the masses, which a swarm of a few particles would not meet by itself."""
    it = sysid.load(STORED / "expressions.h5")
    few = sysid.Swarm(max_iterations=2, n_particles=12, local=None, restarts=0)
    assert sysid.identify(it.problem, rng=0, strategy=few).values["m"].sum() == pytest.approx(5.02, rel=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_saved_anew_it_is_read_the_same(name, tmp_path):
    again = sysid.load(sysid.load(STORED / f"{name}.h5").save(tmp_path))
    assert_stored(again, EXPECTED[name]["stored"])
