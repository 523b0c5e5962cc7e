"""Runs of other lengths have zeros at the lines of one another: these count in no level, no neighbour and no number."""

import numpy as np
import pytest

import sysid
from benchmarks.mistakes.changing import RATE, at_rest, motion, noisy, of_lines
from sysid.modal_analysis.law_spectra import added_by_laws
from sysid.modal_analysis.misfit import misfits_of
from sysid.modal_analysis.outliers import whitened
from sysid.modal_analysis.residues import Records
from sysid.structure.amplitude import FittedLaw, LawForm

M, K = np.diag([2.0, 1.0, 0.0]), np.array([[3900.0, -1500, -2400], [-1500, 1500, 0], [-2400, 0, 2400]])
LENGTHS = 600, 420


@pytest.fixture(scope="module")
def structure():
    return sysid.Structure(M, K, np.array([0.01, 0.02]), n_base=1)


@pytest.fixture(scope="module")
def noise():
    """White noise of unit variance of two sensors under a base that moves as much, in two runs."""
    rng = np.random.default_rng(0)
    runs = [(rng.standard_normal((1, n)), rng.standard_normal((2, n)), None) for n in LENGTHS]
    return sysid.Measurement.from_time(runs, RATE, rigid_body=np.zeros((2, 1)), estimator="spectra")


def test_numbers_are_those_of_each_run(noise):
    assert noise.numbers == 2 * sum(n // 2 for n in LENGTHS) < noise.response.size
    assert Records(noise).data.shape == (2 * sum(n // 2 for n in LENGTHS), 2)


def test_noise_is_what_each_run_has_at_its_own_lines(noise, structure):
    """Of a sample of variance one the spectra, in m/s² s, have a mean square of N / rate² at each line."""
    lines = np.array([n // 2 for n in LENGTHS])
    true = float(lines @ LENGTHS) / lines.sum() / RATE**2
    records = Records(noise)
    assert records.noise(records.data, 0) == pytest.approx(true / 2, rel=0.1)  # a real number's
    ((_, std),) = misfits_of(noise, sysid.Structure(M, 1e9 * K, np.array([0.01, 0.02]), n_base=1), 0)
    assert std[0, 0, 0] ** 2 == pytest.approx(true, rel=0.1)
    nothing = np.zeros_like(noise.response)
    (part,) = whitened(noise, [nothing], 0)
    assert part.std[0, 0, 0] ** 2 == pytest.approx(true, rel=0.15)


def test_numbers_that_stand_alone_are_told_among_those_of_their_run(structure):
    rng = np.random.default_rng(1)
    bases = [at_rest(motion(rng, seconds=n / 4))[None] for n in (60, 50)]
    runs = [(base, of_lines(structure, base) + 0.005 * rng.standard_normal((2, base.shape[1])), None) for base in bases]
    test = sysid.Measurement.from_time(runs, RATE, rigid_body=np.ones((2, 1)), estimator="spectra", band=(0.5, 20.0))
    assert sysid.Problem(test, mass=sysid.FullMass()).prepared.outliers(structure, None) == []
    wrong = sysid.Structure(M * 1.05, K, np.array([0.01, 0.02]), n_base=1)
    assert sysid.Problem(test, mass=sysid.FullMass()).prepared.outliers(wrong, None) == []


@pytest.mark.parametrize("estimator", ["spectra", "records"])
def test_no_more_modes_stand_out_of_five_runs_than_there_are(structure, estimator):
    rng = np.random.default_rng(2)
    bases = [at_rest(motion(rng, seconds=n)) for n in (15, 14, 12, 11, 10)]
    runs = []
    for base in bases:
        records, floors = noisy(rng, base, of_lines(structure, base[None]), 0.1)
        runs.append((base[None] if estimator == "spectra" else records, floors, None))
    test = sysid.Measurement.from_time(runs, RATE, rigid_body=np.ones((2, 1)), estimator=estimator, band=(0.5, 20.0))
    poles = sysid.Problem(test, mass=sysid.FullMass()).poles
    np.testing.assert_allclose(poles.omega / (2 * np.pi), structure.natural_frequencies, rtol=5e-3)


def test_a_law_moves_each_run_of_spectra_as_if_it_were_alone():
    """Lines of all runs together are finer than those of any: their spacing is no run's."""
    law = FittedLaw(4.0, 0.02, 0, LawForm(0.5, 1.0, 20.0), np.array([0.1, 0.01]), (0.1, 20.0), np.eye(4), True)
    stiffness = (2 * np.pi * 4.0) ** 2 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    structure = sysid.Structure(np.diag([1.0, 0.0]), stiffness, [0.02], n_base=1, laws=[law])
    rng, records = np.random.default_rng(0), []
    for samples in (900, 1000):
        base = rng.standard_normal((1, samples)) * np.hanning(samples)
        records.append((base, structure.simulate(base, 100.0), None))

    def added(records):
        test = sysid.Measurement.from_time(records, 100.0, rigid_body=[[1.0]], estimator="spectra", band=(1.0, 9.0))
        return [part[:, lines] for part, lines in zip(added_by_laws(test, structure)[0], test.own_lines, strict=True)]

    for one, record in zip(added(records), records, strict=True):
        np.testing.assert_allclose(one, added([record])[0], rtol=1e-9, atol=1e-12)
