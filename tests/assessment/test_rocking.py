"""A table that turns as it moves is told with its rotation, and no sensor is accused; straight ones are not."""

import dataclasses

import numpy as np
import pytest

import sysid
from sysid import Problem, Sensor
from sysid.structure.sensor import BaseSensor

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
HEIGHTS = np.array([0.6, 1.1, 1.9, 2.4])
MASS = np.array([4.0, 3.0, 5.0, 2.0])
K = 5000.0 * np.array([[2.0, -1, 0, 0], [-1, 2, -1, 0], [0, -1, 2, -1], [0, 0, -1, 1]])
FREQ = np.geomspace(1.2, 13.0, 300)
SLOPE, NOISE, RATE = 0.05, 0.003, 40.0


def responses(freq, slope):
    """Absolute accelerations for unit motion along x of a base that turns by `slope`: the equations of motion solved.

    ``(-w² M + i w C + K) a = w² M (G_x + slope R) u``, C in proportion to M and K.
    """
    rigid = 1.0 + slope * HEIGHTS
    w = 2 * np.pi * freq[:, None, None]
    dynamic = K - w**2 * np.diag(MASS) + 1j * w * (0.2 * np.diag(MASS) + 4e-4 * K)
    return rigid[:, None] + np.linalg.solve(dynamic, w**2 * (MASS * rigid)[:, None])[..., 0].T


def sensors():
    return [Sensor(f"floor {i}", (0.0, 0.0, float(z)), "x") for i, z in enumerate(HEIGHTS, start=1)]


def spectra(slope=SLOPE, freq=FREQ, gains=1.0, noise=NOISE):
    rng, clean = np.random.default_rng(1), responses(freq, slope)
    std = noise * np.sqrt(np.mean(np.abs(clean) ** 2, axis=1, keepdims=True))
    parts = rng.standard_normal((2, *clean.shape)) / np.sqrt(2)
    noisy = np.reshape(gains, (-1, 1)) * (clean + std * (parts[0] + 1j * parts[1]))
    return sysid.Measurement.from_frf(freq, noisy, response_std=std[:, None], sensors=sensors(), base_axes="x")


def records(slope=SLOPE):
    """A run under cosines that are no lines of it, in motion at both ends; noise on all channels."""
    rng, freq = np.random.default_rng(0), np.linspace(0.9, 13.0, 173)
    H = np.concatenate([np.ones((1, freq.size)), responses(freq, slope)])
    waves = rng.normal(size=freq.size) + 1j * rng.normal(size=freq.size)
    clean = ((H * waves) @ np.exp(2j * np.pi * np.outer(freq, np.arange(2400) / RATE))).real
    noisy = clean + NOISE * np.std(clean, axis=1)[:, None] * rng.normal(size=clean.shape)
    return sysid.Measurement.from_time([(noisy[:1], noisy[1:], None)], RATE, sensors=sensors(), base_axes="x",
                                       band=(0.9, 13.0))  # fmt: skip


def found(test):
    return sysid.identify(Problem(test), rng=0).findings


@pytest.mark.parametrize("make", [spectra, records])
def test_a_table_that_rocks_is_told_with_its_rotation(make):
    told, *others = [one for one in found(make()) if one.severity == "contradicts"]
    assert (told.kind, told.channel) == ("table rocks", "base x")
    assert not [one for one in others if one.channel]
    assert told.numbers["slope"] == pytest.approx(SLOPE, abs=4 * told.numbers["std"])
    assert told.numbers["std"] < 0.1 * SLOPE


def test_the_rotation_is_told_where_a_fit_holds_a_pole_below_the_lines_for_it():
    result = sysid.identify(Problem(spectra(freq=np.geomspace(1.2, 8.0, 300), noise=0.001)), rng=0)
    below = np.append(result.structure.natural_frequencies, result.structure.residual.natural_frequencies) < FREQ[0]
    assert below.any()  # so it says nothing of gains, and the note on modes below would be wrong
    kinds = [one.kind for one in result.findings]
    assert "table rocks" in kinds and not {"modes below", "gain", "rigid motion"} & set(kinds)


@pytest.mark.parametrize("make", [spectra, records])
def test_a_straight_table_is_not_told_to_rock(make):
    assert not [one for one in found(make(0.0)) if one.severity == "contradicts"]


@pytest.mark.parametrize(
    ("gains", "channel"), [([1, 1, 1, 1.04], "floor 4"), ([1.04, 1, 1, 1], "floor 1"), ([1.03] * 4, "base x")]
)
def test_wrong_gains_are_told_as_such(gains, channel):
    (told,) = [one for one in found(spectra(0.0, gains=gains)) if one.severity == "contradicts"]
    assert (told.kind in ("gain", "rigid motion"), told.channel) == (True, channel)


@pytest.mark.parametrize("gain", [1.0, 1.02])
def test_a_gain_of_one_base_axis_of_several_is_told_of_the_base(gain):
    """Sensors move with both, so that the gain of none of them is off by as much."""
    rows, w, rng = np.stack([np.ones(4), HEIGHTS], axis=1), 2 * np.pi * FREQ[:, None, None], np.random.default_rng(5)
    dynamic = K - w**2 * np.diag(MASS) + 1j * w * (0.2 * np.diag(MASS) + 4e-4 * K)
    clean = np.moveaxis(rows + np.linalg.solve(dynamic, w**2 * MASS[:, None] * rows), 0, -1) / [[1.0], [gain]]
    std = NOISE * np.sqrt(np.mean(np.abs(clean) ** 2, axis=2, keepdims=True))
    noisy = clean + std * (rng.normal(size=clean.shape) + 1j * rng.normal(size=clean.shape)) / np.sqrt(2)
    test = sysid.Measurement.from_frf(FREQ, noisy, response_std=std, sensors=sensors(), base_axes="x ry")
    told = [(one.kind, one.channel, one.numbers["gain"]) for one in found(test) if one.severity == "contradicts"]
    assert told == ([] if gain == 1 else [("gain", "base ry", pytest.approx(gain, abs=0.003))])


def test_tolerances_of_gains_take_no_rotation_off():
    test = dataclasses.replace(spectra(0.08), gain_std=0.005)
    (told,) = [one for one in found(test) if one.severity == "contradicts"]
    assert told.kind == "table rocks" and told.numbers["slope"] == pytest.approx(0.08, abs=4 * told.numbers["std"])
    assert 0.5 * 0.005 / HEIGHTS.max() < told.numbers["std"] < 0.01


def test_a_mode_below_the_lines_is_no_table_that_rocks():
    f = np.sqrt(np.linalg.eigvals(K / MASS[:, None]).real.min()) / (2 * np.pi)
    lines = np.geomspace(1.6 * f, 13.0, 300)
    assert "table rocks" not in [one.kind for one in found(spectra(0.0, lines))]


def test_a_rotation_that_is_stated_in_rigid_body_is_part_of_the_base_motion():
    rigid = 1.0 + SLOPE * HEIGHTS[:, None]
    test = dataclasses.replace(spectra(), rigid_body=rigid)
    result = sysid.identify(Problem(test), rng=0)
    assert not [one for one in result.findings if one.severity == "contradicts"]
    omega = np.sqrt(np.sort(np.linalg.eigvals(K / MASS[:, None]).real))
    np.testing.assert_allclose(2 * np.pi * result.structure.natural_frequencies, omega, rtol=1e-3)
    with pytest.raises(sysid.InputError, match="'floor 3' has the axis 'x'"):  # no rotation of all
        dataclasses.replace(test, rigid_body=rigid + np.diag([0.0, 0.0, 0.05, 0.0])[:, 2:3])


def test_without_positions_nothing_is_told_of_a_table():
    plain = dataclasses.replace(spectra(), sensors=None)
    assert "table rocks" not in [one.kind for one in found(plain)]


@pytest.mark.parametrize(("tolerance", "told"), [(0.0, 1), (0.02, 0)])
def test_base_sensors_that_differ_are_told_beyond_their_tolerance(tolerance, told, tmp_path):
    read = (BaseSensor("near", 0.98, 0.02 / 0.98), BaseSensor("far", 1.02, 0.02 / 1.02))
    test = dataclasses.replace(spectra(0.0), base_sensors=read, base_gain_std=tolerance)
    result = sysid.identify(Problem(test), rng=0)
    result = sysid.load(result.save(tmp_path / "result.h5"))
    assert result.measurement.base_sensors == read
    notes = [one for one in result.findings if one.kind == "base sensors"]
    assert [one.severity for one in notes] == ["note"] * told
    assert [one.numbers["most"] for one in notes] == [pytest.approx(0.02)] * told


@pytest.mark.parametrize(("slope", "severity"), [(0.0, "note"), (0.05, "contradicts")])
def test_supports_that_move_apart_speak_against_a_misfit_alone(slope, severity):
    read = (BaseSensor("west", 1.0, 0.06), BaseSensor("east", 1.01, 0.06))
    test = dataclasses.replace(spectra(slope), base_sensors=read)
    supports = [one for one in found(test) if one.kind in ("supports differ", "base sensors")]
    assert [(one.kind, one.severity) for one in supports] == [("supports differ", severity)]
    assert supports[0].numbers["most"] == pytest.approx(0.06)


def test_base_sensors_that_differ_by_gains_alone_are_no_supports():
    read = tuple(BaseSensor(name, gain, abs(1 - 1 / gain)) for name, gain in (("west", 0.85), ("east", 1.15)))
    kinds = [one.kind for one in found(dataclasses.replace(spectra(0.0), base_sensors=read))]
    assert "base sensors" in kinds and "supports differ" not in kinds
