"""A test alone, of whose structure nothing is stated: the problem of `Problem(test)` and of a run of a test file."""

import numpy as np
import pytest

import sysid
from sysid import catalogue
from sysid.files.recorded_test import RecordedTest

K = [[4e3, -2e3, -2e3], [-2e3, 2e3, 0], [-2e3, 0, 2e3]]
TRUTH = sysid.Structure(np.diag([5.0, 4.0, 1.0]), K, [0.01, 0.015], n_base=1)
FREQ = np.linspace(0.5, 8.0, 150)


def test_it_is_the_problem_of_a_run_of_the_file_of_the_test(tmp_path):
    test = sysid.simulate(TRUTH, FREQ, force=True)
    sensors = [sysid.Sensor("low", (0, 0, 1), "x"), sysid.Sensor("high", (0, 0, 2), "x")]
    run = test.base[0], test.response[0], test.force[0]
    file = tmp_path / "test.h5"
    file.write_bytes(RecordedTest((run,), tuple(sensors), ("x",), (0.0, 0.0, 0.0), None, FREQ, ()).to_bytes())
    made = catalogue.build(sysid.Recipe("recorded_test", str(file)))
    assert [type(model) for model in made.models] == [sysid.FullMass, sysid.SpectralStiffness, sysid.ModalDamping]
    assert [m.to_tree() for m in made.models] == [m.to_tree() for m in sysid.Problem(test).models]


def test_with_the_base_force_its_matrices_are_those_of_the_truth():
    result = sysid.identify(sysid.Problem(sysid.simulate(TRUTH, FREQ, force=True)), rng=0)
    assert result.judgement == "determined"
    np.testing.assert_allclose(result.structure.mass, TRUTH.mass, atol=1e-7)
    np.testing.assert_allclose(result.structure.stiffness, TRUTH.stiffness, atol=1e-4)


def test_without_it_modal_masses_are_open_and_normalised():
    result = sysid.identify(sysid.Problem(sysid.simulate(TRUTH, FREQ)), rng=0)
    assert result.judgement == "one of many" and result.success
    assert result.facts.unit_mass and result.open_masses
    assert result.structure.rigid_body_mass == pytest.approx(np.eye(1))
    np.testing.assert_allclose(result.structure.natural_frequencies, TRUTH.natural_frequencies, rtol=1e-8)
