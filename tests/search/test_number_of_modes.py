"""So many modes as are asked for, by `Modal(modes=)` or by stated frequencies, where others lie beyond the lines.

A chain of six masses: four modes within the lines, two beyond.
"""

import importlib

import numpy as np
import pytest

import sysid
from sysid.modal_analysis.fit import estimate
from sysid.modal_analysis.modal_fit import modes_within
from sysid.modal_analysis.record_fit import RecordFit
from sysid.structure.structure import Structure

# How many modes are asked for comes after the fit of the records.
pytestmark = pytest.mark.usefixtures("fitted_once", "from_one_start_in_module")

M, K = np.array([2.0, 3.0, 2.5, 4.0, 3.0, 2.0]), np.array([5.0, 4.0, 4.5, 3.0, 3.5, 2.5]) * 1e4
N, AT = M.size, np.array([0, 2, 3, 5])


@pytest.fixture(scope="module")
def truth():
    k, one = np.diag(K + np.append(K[1:], 0)) - np.diag(K[1:], 1) - np.diag(K[1:], -1), np.ones((N, 1))
    full = np.block([[k, -k @ one], [-one.T @ k, one.T @ k @ one]])
    return Structure(np.diag([*M, 1.0]), full, np.linspace(0.008, 0.015, N), n_base=1)


@pytest.fixture(scope="module")
def ends(truth):
    f = truth.natural_frequencies
    return 0.5 * f[0], 0.6 * f[3] + 0.4 * f[4]


@pytest.fixture(scope="module")
def spectra(truth, ends):
    test = sysid.simulate(truth, np.linspace(*ends, 400), noise=0.01, force=True, rng=0)
    return test.of_sensors(np.isin(np.arange(N), AT))


@pytest.fixture(scope="module")
def records(truth, ends):
    """A quarter of a minute from rest, 1 % of noise in all channels."""
    rng, rate = np.random.default_rng(0), 150.0
    base = rng.standard_normal((1, int(15 * rate)))
    channels = base, truth.simulate(base, rate)[AT], truth.simulate_force(base, rate)
    noisy = [x + 0.01 * x.std(axis=1, keepdims=True) * rng.standard_normal(x.shape) for x in channels]
    return sysid.Measurement.from_time([tuple(noisy)], rate, rigid_body=truth.rigid_body[AT], band=ends)


@pytest.fixture
def at_once(monkeypatch):
    """Nothing may be fitted."""
    monkeypatch.setattr(importlib.import_module("sysid.identify"), "prepare", lambda *_: pytest.fail("a fit began"))


@pytest.fixture(params=["spectra", "records"])
def test(request):
    return request.getfixturevalue(request.param)


@pytest.fixture(scope="module")
def three(spectra):
    return found(spectra, modes=3)


def found(test, *, stiffness=None, **settings):
    given = {} if stiffness is None else {"stiffness": stiffness}
    return sysid.identify(sysid.Problem(test, **given), strategy=sysid.Modal(**settings), rng=0)


def test_as_many_as_there_are_within_the_lines_are_those_of_the_default(test, truth):
    """What stands for the modes beyond the lines comes on top and is not counted."""
    asked, default = found(test, modes=4), sysid.identify(sysid.Problem(test), rng=0)
    assert asked.judgement == "determined" and asked.structure.residual.count >= 1
    np.testing.assert_allclose(asked.structure.natural_frequencies, truth.natural_frequencies[:4], rtol=1e-3)
    np.testing.assert_allclose(asked.structure.natural_frequencies, default.structure.natural_frequencies, rtol=1e-6)
    np.testing.assert_allclose(asked.structure.mass, default.structure.mass, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("count", [1, 3])
def test_fewer_are_those_that_the_records_need_most(request, truth, count):
    """They are right, and the result tells which stand out besides, and that the records are not explained."""
    result = request.getfixturevalue("three") if count == 3 else found(request.getfixturevalue("records"), modes=1)
    f, size = truth.natural_frequencies[:4], result.structure.natural_frequencies.size
    assert size == count == result.structure.n
    which = np.argmin(np.abs(np.log(result.structure.natural_frequencies / f[:, None])), axis=0)
    assert np.unique(which).size == count
    np.testing.assert_allclose(result.structure.natural_frequencies, f[which], rtol=5e-3)
    assert result.judgement == "no fit" and result.residual > 0.05  # of 1 % noise
    (said,) = [str(one) for one in result.of_kind("search") if "left out" in str(one)]
    assert all(f"{others:.2f}"[:3] in said for others in np.delete(f, which))


def test_the_weakest_of_the_modes_goes_first(spectra, truth, three):
    """Against the motion that each mode of the truth makes at the sensors."""
    f, w = truth.natural_frequencies[:4], 2 * np.pi * spectra.freq
    wk, zeta = 2 * np.pi * f[:, None], truth.damping_ratios[:4, None]
    motion = w**2 / (wk**2 - w**2 + 2j * zeta * wk * w)
    power = np.linalg.norm(truth.normal_modes[AT, :4], axis=0) * np.abs(truth.participation[:4, 0])
    weakest = np.argmin(power * np.linalg.norm(motion, axis=1))
    left = three.structure.natural_frequencies
    np.testing.assert_allclose(left, np.delete(f, weakest), rtol=5e-3)


def test_more_than_stand_out_is_refused_with_their_number(test):
    with pytest.raises(sysid.InputError, match="4 modes stand out of the noise, fewer than the 5 asked for"):
        found(test, modes=5)


@pytest.mark.parametrize(
    ("settings", "stiffness", "told"),
    [
        ({"modes": 5000}, None, "modes=5000, and these [0-9]+ lines hold [0-9]+ at most"),
        ({"modes": 3}, sysid.SpectralStiffness([2.0, 6.0]), "modes=3, and SpectralStiffness states 2 frequencies"),
        ({"modes": 2, "sensors": [0, 1, 2]}, None, "modes=2, and 3 sensors are named"),
        ({"sensors": ["no such"]}, None, "'no such' is no sensor; the sensors are sensor 1, sensor 2"),
    ],
)
def test_what_no_fit_can_give_is_refused_before_any(at_once, test, settings, stiffness, told):
    with pytest.raises(sysid.InputError, match=told):
        found(test, stiffness=stiffness, **settings)


def test_a_mass_of_its_own_form_has_a_mode_a_sensor(at_once, spectra):
    problem = sysid.Problem(spectra, mass=sysid.LumpedMass(16.5))
    with pytest.raises(sysid.InputError, match="modes=2; with this mass there are 4"):
        sysid.identify(problem, strategy=sysid.Modal(modes=2), rng=0)


@pytest.mark.parametrize(("kind", "which"), [("spectra", [0, 1, 2, 3]), ("spectra", [0, 2]), ("records", [0, 2])])
def test_stated_frequencies_are_the_modes_of_the_answer(request, truth, kind, which):
    """Each is given to two digits; modes between and beside them are none of the structure's."""
    stated = [float(f"{f:.2g}") for f in truth.natural_frequencies[which]]
    problem = sysid.Problem(request.getfixturevalue(kind), stiffness=sysid.SpectralStiffness(stated))
    result = sysid.identify(problem, rng=0)
    assert result.strategy == "modal" and result.structure.n == len(which)
    np.testing.assert_allclose(result.structure.natural_frequencies, truth.natural_frequencies[which], rtol=5e-3)
    assert result.determined == (len(which) == 4)


def test_a_higher_limit_of_frequencies_adds_no_modes(spectra, truth):
    stated = truth.natural_frequencies[:3].round(1)
    stiffness = sysid.SpectralStiffness(stated, max_frequency=100.0)
    assert found(spectra, stiffness=stiffness).structure.n == 3


def test_a_frequency_that_is_stated_twice_needs_two_modes(spectra, truth):
    stiffness = sysid.SpectralStiffness(np.repeat(truth.natural_frequencies[0], 2))
    with pytest.raises(sysid.InputError, match="1 mode stands out of the noise, fewer than the 2 asked for"):
        found(spectra, stiffness=stiffness)


def test_two_modes_at_one_pole_are_found_where_two_are_asked_for():
    """Equal oscillators along x and y: one pole, a residue of rank two."""
    k, zero = 1e3 * np.diag([1.0, 1.0, 3.0]), np.zeros((2, 2))
    G = np.array([[1.0, 0], [0, 1.0], [0.6, 0.8]])
    full = np.block([[k, -k @ G], [-(k @ G).T, G.T @ k @ G]])
    mass = np.block([[np.diag([1.0, 1.0, 2.0]), np.zeros((3, 2))], [np.zeros((2, 3)), zero]])
    truth = Structure(mass, full, [0.01, 0.01, 0.01], n_base=2)
    f = truth.natural_frequencies
    test = sysid.simulate(truth, np.linspace(2.0, 9.0, 200), force=True)
    result = found(test, modes=3)
    np.testing.assert_allclose(result.structure.natural_frequencies, f, rtol=1e-6)
    assert found(test, modes=2).structure.n == 2


def test_fewer_modes_of_whole_records_have_the_information_that_the_others_leave(records):
    """Covariances of the modes that stay are those of all modes together, also after a file."""
    problem = sysid.Problem(records)
    result = sysid.identify(problem, strategy=sysid.Modal(modes=2), rng=0)
    fit = result.prepared.modal[0].record_fit
    some, every = estimate(fit), estimate(RecordFit.from_tree({**fit.to_tree(), "kept": None}, records))
    m, n = every.omega.size, records.n_sensors
    assert some.omega.size < m
    at = np.flatnonzero(np.isin(every.omega, some.omega))
    places = {"information": n * m + m + at, "few": n * at.size + at.size + np.arange(at.size)}  # log omega
    of_all = np.linalg.pinv(_scaled(every.information)[0], hermitian=True)
    of_some = np.linalg.pinv(_scaled(some.information)[0], hermitian=True)
    std = [
        np.sqrt(np.diag(cov))[rows] / size[rows]
        for cov, size, rows in (
            (of_all, _scaled(every.information)[1], places["information"]),
            (of_some, _scaled(some.information)[1], places["few"]),
        )
    ]
    np.testing.assert_allclose(std[1], std[0], rtol=1e-5)


def _scaled(A):
    size = np.sqrt(np.diag(A))
    size = np.where(size > 0, size, 1.0)
    return A / np.outer(size, size), size


def test_a_result_of_fewer_modes_is_the_same_when_it_is_loaded(test, tmp_path):
    result = found(test, modes=2)
    result.save(tmp_path / "two.h5")
    again = sysid.load(tmp_path / "two.h5")
    assert again.structure.n == 2 and again.judgement == result.judgement
    assert again.residual == pytest.approx(result.residual, rel=1e-9)
    assert again.summary() == result.summary()


def test_modes_are_within_the_lines_or_nearest_to_what_is_stated():
    none = np.zeros(0)
    omega, ends = np.array([1.0, 2.0, 2.1, 5.0]), (1.5, 3.0)
    assert modes_within(omega, ends, none).tolist() == [False, True, True, False]
    assert modes_within(np.array([4.0, 5.0]), ends, none).tolist() == [True, True]
    assert modes_within(omega, ends, np.array([2.1, 2.1])).tolist() == [False, True, True, False]
    assert modes_within(omega, ends, np.array([2.1, 2.1]), 0.01).tolist() == [False, False, True, False]
    assert modes_within(omega, ends, np.array([5.1]), 0.1).tolist() == [False, False, False, True]
