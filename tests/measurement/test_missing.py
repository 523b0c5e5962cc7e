"""Lines at which a record is NaN: left out on request, refused by name otherwise; what follows from lines with gaps."""

import dataclasses
import re

import numpy as np
import pytest

import sysid
from sysid import InputError, Measurement
from sysid.measurement.spectra import in_words
from sysid.modal_analysis.residues import line_correlation

LINES = 8


@pytest.fixture
def records():
    """Two runs, two base directions, three sensors, eight lines, and deviations of each kind that broadcasts."""
    rng = np.random.default_rng(3)
    normal = lambda *shape: rng.normal(size=shape) + 1j * rng.normal(size=shape)  # noqa: E731
    return {
        "freq": np.linspace(1, 8, LINES),
        "base": normal(2, 2, LINES),
        "response": normal(2, 3, LINES),
        "force": normal(2, 2, LINES),
        "rigid_body": rng.uniform(-0.5, 0.5, (3, 2)),
        "response_std": rng.uniform(0.1, 1.0, (3, 1)),
        "force_std": rng.uniform(0.1, 1.0, LINES),
    }


def test_lines_with_any_hole_are_left_out_and_all_others_stay_as_they_are(records):
    holed = {name: np.array(value) for name, value in records.items()}
    holed["base"][1, 0, 0] = np.nan
    holed["response"][0, 2, 3] = 1j * np.nan
    holed["response"][1, 1, 3] = np.nan
    holed["force"][0, 1, 5] = np.nan
    holed["force_std"][7] = np.nan
    found = Measurement(**holed, missing="drop")
    kept = [1, 2, 4, 6]
    by_hand = records | {name: records[name][..., kept] for name in ("freq", "base", "response", "force", "force_std")}
    wanted = Measurement(**by_hand)
    for name in ("freq", "base", "response", "force", "response_std", "force_std"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
    assert (found.dropped, wanted.dropped) == (4, 0)
    assert re.findall(r"\d+", found.lines_in_words) == ["4", "2", "7", "4"] and found.lines_in_words in repr(found)
    assert found.in_band(2, 6).dropped == dataclasses.replace(found).dropped == 4
    again = Measurement.from_tree(found.to_tree())
    assert again.dropped == 4
    told = [("base", [1.0]), ("sensor 2", [4.0]), ("sensor 3", [4.0]), ("force", [6.0]), ("force_std", [8.0])]
    for test in (found, again):
        assert {name: freq.tolist() for name, freq in test.holes} == dict(told)
    np.testing.assert_array_equal(found.gaps, [2, 3])  # before 5 Hz and 7 Hz, of 2, 3, 5 and 7 Hz


def test_frequency_response_functions_with_holes(records):
    H, force = records["response"][:2].swapaxes(0, 1).copy(), records["force"].copy()
    H[1, 0, 2], force[1, 1, 6] = np.nan, np.nan
    given = {"rigid_body": records["rigid_body"], "force": force, "response_std": 0.1, "force_std": 0.2}
    found = Measurement.from_frf(records["freq"], H, **given, missing="drop")
    kept = [0, 1, 3, 4, 5, 7]
    np.testing.assert_array_equal(found.response, H[..., kept].swapaxes(0, 1))
    np.testing.assert_array_equal(found.force, force[..., kept].swapaxes(0, 1))
    assert (found.freq.size, found.dropped) == (6, 2)
    assert in_words(found.holes, found.freq) == "sensor 2 at 3 Hz; force at 7 Hz"
    H[1, 0, 3:5] = np.nan
    test = Measurement.from_frf(records["freq"], H, **given, missing="drop")
    assert in_words(test.holes, test.freq) == "sensor 2 at 3 to 5 Hz; force at 7 Hz"
    with pytest.raises(InputError, match=r"frf holds NaN .*index \(1, 0, 2\)\); missing='drop' leaves out the lines"):
        Measurement.from_frf(records["freq"], H, **given)


@pytest.mark.parametrize("name", ["base", "response", "force", "force_std"])
def test_a_refusal_says_how_holes_are_left_out(records, name):
    holed = records[name].copy()
    holed[..., 4] = np.nan
    with pytest.raises(InputError, match=f"{name} holds NaN .*first at index .*; missing='drop' leaves out"):
        Measurement(**records | {name: holed})


def test_what_dropping_cannot_mend_is_refused(records):
    infinite = records["response"].copy()
    infinite[0, 0, 1] = np.inf
    for missing in ("refuse", "drop"):
        with pytest.raises(InputError, match=r"response holds NaN or infinite .*index \(0, 0, 1\)\)$"):
            Measurement(**records | {"response": infinite}, missing=missing)
    dead = records["response"].copy()
    dead[1, 2] = np.nan
    with pytest.raises(InputError, match="leaves no line: of 8, NaN stands in response at 8$"):
        Measurement(**records | {"response": dead}, missing="drop")
    with pytest.raises(InputError, match="leaves no line: of 8, NaN stands in response_std at 8"):
        Measurement(**records | {"response_std": [[0.1], [np.nan], [0.1]]}, missing="drop")
    with pytest.raises(InputError, match="freq holds NaN"):
        Measurement(**records | {"freq": np.where(np.arange(LINES) == 2, np.nan, records["freq"])}, missing="drop")
    with pytest.raises(InputError, match="response has shape"):
        Measurement(**records | {"response": np.ones((2, 3, 5))}, missing="drop")
    with pytest.raises(InputError, match="missing = 'mask' is unknown"):
        Measurement(**records, missing="mask")


def test_errors_that_neighbours_share_are_counted_alike_with_gaps():
    """Moving average of three: sums of errors have the variance of white noise times 1 + 2 · share · (2/3 + 1/6)."""
    rng = np.random.default_rng(5)
    white = rng.normal(size=(40, 2002)) + 1j * rng.normal(size=(40, 2002))
    smeared = white[:, :-2] + 2 * white[:, 1:-1] + white[:, 2:]  # as Hann's window does
    for share in (1.0, 0.9):
        kept = np.sort(rng.permutation(2000)[: int(2000 * share)])
        assert line_correlation(smeared[:, None, kept]) == pytest.approx(1 + 2 * share * (2 / 3 + 1 / 6), rel=0.02)


def test_a_noisy_test_with_a_tenth_of_its_lines_missing_has_honest_deviations(random_structure):
    rng = np.random.default_rng(8)
    truth = random_structure(rng, n=2, d=1, frequencies=[6.0, 11.0], ratios=np.array([0.02, 0.03]))
    freq, off, apart = np.linspace(3, 16, 160), [], []
    for _ in range(8):
        test = sysid.simulate(truth, freq, noise=0.01, force=True, rng=rng)
        holed = test.response.copy()
        holed[0, rng.integers(2, size=16), rng.permutation(160)[:16]] = np.nan
        whole = dataclasses.replace(test, response_std=None, force_std=None)
        holed = dataclasses.replace(whole, response=holed, missing="drop")
        ends = [sysid.identify(sysid.Problem(t, mass=sysid.FullMass()), rng=0) for t in (whole, holed)]
        assert [one.numbers["lines"] for one in ends[1].of_kind("lines left out")] == [16]
        for name in ("natural_frequencies", "damping_ratios"):
            std = getattr(ends[1].uncertainty, name)
            off.append((getattr(ends[1].structure, name) - getattr(truth, name)) / std)
            apart.append((getattr(ends[1].structure, name) - getattr(ends[0].structure, name)) / std)
    # 32 standard normal numbers, the seed is fixed; the two answers differ by what a tenth of the lines tells.
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3
    assert np.sqrt(np.mean(np.square(apart))) < 0.6
