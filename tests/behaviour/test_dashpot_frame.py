"""The problem of a frame with a dashpot between floors, against its truth and beside the frame without it."""

import numpy as np
import pytest

import sysid
from sysid import catalogue


def identified(**parameters):
    return sysid.identify(catalogue.build(sysid.Recipe("dashpot_frame", parameters=parameters)), rng=0)


def test_mass_stiffness_and_the_whole_of_damping_are_within_their_deviations(tmp_path):
    result = identified()
    truth = result.problem.reference
    assert result.judgement == "determined"
    (told,) = (one for one in result.findings if one.kind == "damping")
    assert told.severity == "note"
    assert told.numbers["deviations"] > 10
    for found, true, error in (
        (result.structure.mass, truth.mass, result.uncertainty.mass),
        (result.structure.stiffness, truth.stiffness, result.uncertainty.stiffness),
        (result.structure.damping, truth.damping, result.uncertainty.damping),
    ):
        assert np.all(np.abs(found - true)[:4, :4] < 4 * error)
    assert result.uncertainty.damping[1, 2] < 0.05 * abs(truth.damping[1, 2])  # and they say something
    again = sysid.load(result.save(tmp_path / "result.h5"))
    assert np.array_equal(again.structure.damping, result.structure.damping)


def test_without_the_dashpot_the_modes_are_classical_and_so_is_what_is_told():
    result = identified(dashpot=0.0)
    assert result.judgement == "determined"
    assert result.structure.modal_damping
    assert not any(one.kind == "damping" for one in result.findings)


def test_it_takes_no_records(tmp_path):
    with pytest.raises(sysid.InputError, match="dashpot_frame is simulated"):
        catalogue.build(sysid.Recipe("dashpot_frame", str(tmp_path)))
