"""A sensor on a soft bracket is named, with the bracket's frequency, where redundancy shows it; others are not."""

import dataclasses
import functools

import numpy as np
import pytest

import sysid
from benchmarks.channels.brackets import one_test
from benchmarks.records.simulated import four_storeys
from sysid import FullMass, LumpedMass, Problem, Sensor, Structure, simulate
from sysid.assessment.checks import brackets
from sysid.assessment.checks.brackets import Misfit, beside_rigid, softest

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")
KIND = "soft bracket"
NOISE = 0.003


def storeys():
    """Four storeys on a base without mass."""
    k = np.array([5e5, 4e5, 3e5, 3e5])
    K = np.zeros((5, 5))
    for i in range(4):
        e = np.zeros(5)
        e[i], e[i - 1 if i else 4] = 1.0, -1.0
        K += k[i] * np.outer(e, e)
    return Structure(np.diag([4.0, 3.0, 5.0, 3.0, 0.0]), K, [0.01, 0.015, 0.02, 0.01], n_base=1)


def block():
    """Three coordinates of a rigid block in a plane, on a base that moves along x; four sensors, of which three do."""
    M = np.array([[8.0, 0.0, 0.4, 0.0], [0.0, 8.0, 0.2, 0.0], [0.4, 0.2, 0.5, 0.0], [0.0, 0.0, 0.0, 0.0]])
    K = np.array([[4e4, 8e3, 5e3], [8e3, 9e4, -6e3], [5e3, -6e3, 9e3]])
    along = np.array([1.0, 0.0, 0.0])  # the block moves with the base
    whole = np.vstack([np.column_stack([K, -K @ along]), np.append(-K @ along, along @ K @ along)])
    sensors = [
        Sensor("low", (0.0, 0.0, -0.1), "x", part="block"), Sensor("high", (0.05, 0.0, 0.25), "x", part="block"),
        Sensor("left", (-0.3, 0.0, 0.0), "z", part="block"), Sensor("right", (0.2, 0.0, 0.1), "z", part="block"),
    ]  # fmt: skip
    rows = np.array([
        [1.0, 0.0, one.position[2]] if one.axis == "x" else [0.0, 1.0, -one.position[0]] for one in sensors
    ])  # fmt: skip
    rigid = rows @ along[:, None]
    return Structure(
        M, whole, [0.01, 0.02, 0.015], n_base=1, recovery=rows, rigid_body=rigid, sensors=sensors
    ), sensors  # fmt: skip


def shaken(truth, sensors=None, rng=0, force=True):
    f = truth.natural_frequencies
    lines = np.unique(np.concatenate([
        np.geomspace(0.4 * f[0], 1.2 * f[-1], 300), *(np.linspace(0.96, 1.04, 31) * one for one in f)
    ]))  # fmt: skip
    clean = simulate(truth, lines, force=force)
    rng = np.random.default_rng(rng)

    def noisy(record):
        std = NOISE * np.sqrt(np.mean(np.abs(record) ** 2, axis=-1, keepdims=True))
        parts = rng.standard_normal((2, *record.shape)) / np.sqrt(2)
        return record + std * (parts[0] + 1j * parts[1]), std

    response, std = noisy(clean.response)
    records = {"response": response, "response_std": std}
    if force:
        records["force"], records["force_std"] = noisy(clean.force)
    return dataclasses.replace(clean, sensors=sensors or clean.sensors, **records)


def on_bracket(test, sensor, frequency, ratio=0.02):
    """The test with one record as a sensor on a bracket reads it."""
    x = test.freq / frequency
    response = test.response.copy()
    response[:, sensor] /= 1 - x**2 + 2j * ratio * x
    return dataclasses.replace(test, response=response)


def told(result):
    return [(one.channel, one.numbers["frequency"], one.numbers["std"]) for one in result.of_kind(KIND)]


@functools.cache
def lumped(rng):
    """The answer of a right test of the storeys, whose mass is said to be diagonal."""
    return sysid.identify(Problem(shaken(storeys(), rng=rng), mass=LumpedMass()), rng=0)


@functools.cache
def rigid(rng):
    """The answer of a right test of the block, whose sensors are said to be on one rigid part."""
    return sysid.identify(Problem(shaken(*block(), rng=rng)), rng=0)


class TestStatedMass:
    @pytest.mark.parametrize(("sensor", "times"), [(1, 2.0), (3, 4.0)])
    def test_names_the_sensor_and_its_bracket(self, sensor, times):
        truth = storeys()
        soft = times * truth.natural_frequencies[-1]
        result = sysid.identify(Problem(on_bracket(shaken(truth), sensor, soft), mass=LumpedMass()), rng=0)
        ((channel, frequency, std),) = told(result)
        assert channel == f"sensor {sensor + 1}" and result.contradictions[0].kind == KIND
        assert abs(frequency - soft) < max(4 * std, 0.02 * soft)

    @pytest.mark.parametrize("seed", range(3))
    def test_names_none_of_a_right_test(self, seed):
        assert lumped(seed).determined and not told(lumped(seed))

    @pytest.mark.parametrize("sensor", [0, 3])
    def test_leaves_a_gain_a_gain(self, sensor):
        test = shaken(storeys())
        response = test.response.copy()
        response[:, sensor] *= 1.03
        result = sysid.identify(Problem(dataclasses.replace(test, response=response), mass=LumpedMass()), rng=0)
        assert not told(result)
        assert f"sensor {sensor + 1}" in [one.channel for one in result.of_kind("gain", "rigid motion")]

    def test_a_written_model_tells_it_too(self):
        truth = storeys()
        test = on_bracket(shaken(truth), 2, 3 * truth.natural_frequencies[-1])
        stated = {"mass": truth.mass[:4, :4], "stiffness": sysid.ChainStiffness(1e5, 1e6)}
        result = sysid.identify(Problem(test, **stated), rng=0)
        assert [channel for channel, *_ in told(result)] == ["sensor 3"]

    def test_rows_without_any_scatter_are_left_out(self, monkeypatch):
        """Few stretches of records that squares took tell none along some."""
        seen, plain = [], brackets.stacked_rows

        def without_scatter(rows):
            every = plain(rows)
            return dataclasses.replace(every, std=np.where(np.arange(every.std.size) % 5 == 0, 0.0, every.std))

        def noted(misfit, top):
            seen.append(misfit)
            return softest(misfit, top)

        monkeypatch.setattr(brackets, "stacked_rows", without_scatter)
        monkeypatch.setattr(brackets, "softest", noted)
        assert not told(sysid.identify(Problem(shaken(storeys()), mass=LumpedMass()), rng=0))
        assert seen and all(np.all(np.isfinite(part)) for misfit in seen for part in misfit)

    def test_names_none_beside_a_free_mass_which_takes_it_up(self):
        test = on_bracket(shaken(storeys()), 2, 3 * storeys().natural_frequencies[-1])
        assert not told(sysid.identify(Problem(test, mass=FullMass()), rng=0))


class TestRigidPart:
    @pytest.mark.parametrize(
        "sensor", range(3)
    )  # a gain of the last, which the base does not show, does nearly as well
    def test_names_the_sensor_and_its_bracket(self, sensor):
        truth, sensors = block()
        soft = 3 * truth.natural_frequencies[-1]
        result = sysid.identify(Problem(on_bracket(shaken(truth, sensors), sensor, soft)), rng=0)
        ((channel, frequency, std),) = told(result)
        assert channel == sensors[sensor].name
        assert abs(frequency - soft) < max(4 * std, 0.02 * soft)

    @pytest.mark.parametrize("seed", range(2))
    def test_names_none_of_a_right_test_nor_where_no_part_is_stated(self, seed):
        truth, sensors = block()
        assert not told(rigid(seed))
        loose = [dataclasses.replace(one, part="") for one in sensors]
        test = on_bracket(shaken(truth, loose, rng=seed), 0, 3 * truth.natural_frequencies[-1])
        assert not told(sysid.identify(Problem(test), rng=0))

    def test_a_wrong_gain_of_whole_records_is_no_bracket_of_another_sensor(self):
        """What it adds to the base's motion is taken off such records, but not what it adds to the modes."""
        found = one_test(("gain", 38))
        assert not found.told and found.said.startswith("gain: s4 reads 3 % high")

    def test_sums_of_sensors_are_those_that_no_rigid_motion_makes(self):
        at = lambda x, axis="x": Sensor(f"{x}{axis}", (7.0, 0.0, x), axis, part="deck")  # noqa: E731
        test = dataclasses.replace(shaken(storeys()), sensors=[at(0.0), at(1.0), at(2.0), at(2.0)])
        (line,) = beside_rigid(test, np.array([True, True, True, False]))
        np.testing.assert_allclose(line / line[0], [1.0, -2.0, 1.0, 0.0], atol=1e-12)
        (same,) = beside_rigid(test, np.array([False, False, True, True]))
        np.testing.assert_allclose(same / same[2], [0.0, 0.0, 1.0, -1.0], atol=1e-12)
        assert len(beside_rigid(test, np.array([True, True, False, False]))) == 0
        assert len(beside_rigid(test, np.array([True, False, False, False]))) == 0


class TestSoftest:
    def make(self, rng, softness, beside, b=0.0, gains=None):
        left = rng.standard_normal(len(softness)) - softness @ np.broadcast_to(b, softness.shape[1])
        gains = np.zeros((len(softness), 0)) if gains is None else gains
        return Misfit(left, softness, softness, beside, gains)

    def test_is_the_parameter_within_its_deviations(self):
        rng = np.random.default_rng(2)
        softness, beside = 200 * rng.standard_normal((300, 3)), rng.standard_normal((300, 5))
        found = softest(self.make(rng, softness, beside, [0.0, 0.02, 0.0]), top=4.0)
        assert found.sensor == 1 and not found.others
        left = softness - beside @ np.linalg.lstsq(beside, softness, rcond=None)[0]
        assert found.std == pytest.approx(1 / np.linalg.norm(left[:, 1]), rel=0.1)
        assert abs(found.softness - 0.02) < 4 * found.std

    @pytest.mark.parametrize("b", [[0.0, -0.02, 0.0], [0.02, 0.02, 0.0], [0.0, 0.05, 0.0]])
    def test_is_none_that_reads_too_little_none_of_two_and_none_near_the_lines(self, b):
        """A bracket reads too much; one explains not what two do; one of 0.05 s² is a mode at 4.5 rad/s."""
        rng = np.random.default_rng(3)
        softness, beside = 200 * rng.standard_normal((300, 3)), rng.standard_normal((300, 5))
        assert softest(self.make(rng, softness, beside, b), top=4.0) is None

    def test_leaves_it_to_a_gain_that_explains_it_as_well_and_tells_two_that_are_alike(self):
        rng = np.random.default_rng(4)
        softness, beside = 200 * rng.standard_normal((300, 2)), rng.standard_normal((300, 5))
        softness[:, 1] = softness[:, 0]
        assert softest(self.make(rng, softness, beside, [0.02, 0.0]), top=4.0).others == (1,)
        assert softest(self.make(rng, softness, beside, [0.02, 0.0], gains=softness[:, :1]), top=4.0) is None

    def test_false_alarms_are_as_rare_as_stated(self):
        rng = np.random.default_rng(5)
        softness, beside = rng.standard_normal((40, 4)), rng.standard_normal((40, 6))
        found = [softest(self.make(rng, 1e3 * softness, beside), top=4.0, least=0.0) for _ in range(3000)]
        assert np.count_nonzero([one is not None for one in found]) <= 9  # of 3 expected


class TestAssumptions:
    def kinds(self, result):
        return [one.kind for one in result.assumptions]

    def test_are_those_that_matter_to_the_answer(self):
        test = shaken(storeys())
        free = sysid.identify(Problem(test, mass=FullMass()), rng=0)
        assert self.kinds(free) == ["assumed force gain", "assumed mounting", "assumed base"]
        assert "assumed mass" in self.kinds(lumped(0)) and "assumed mounting" not in self.kinds(lumped(0))
        assert not set(self.kinds(free)) & {one.kind for one in free.findings}

    def test_a_goal_that_is_met_makes_a_bracket_a_caution(self):
        test = on_bracket(shaken(storeys()), 2, 4 * storeys().natural_frequencies[-1])
        (one,) = sysid.identify(Problem(test, mass=LumpedMass(), goal=0.1), rng=0).of_kind(KIND)
        assert one.severity == "caution"

    def test_leave_out_mountings_that_a_rigid_part_tells(self):
        truth, sensors = block()
        assert "assumed mounting" not in self.kinds(rigid(0))
        three = [*sensors[:3], dataclasses.replace(sensors[3], part="")]
        (one,) = [one for one in sysid.identify(Problem(shaken(truth, three)), rng=0).assumptions
                  if one.kind == "assumed mounting"]  # fmt: skip
        assert one.numbers == {"sensors": 4.0}

    def test_stand_in_summary_and_file_and_are_read_again(self, tmp_path):
        result = lumped(0)
        assert [one["kind"] for one in result.to_dict()["assumptions"]] == self.kinds(result)
        assert result.summary().count("assumed: ") == len(result.assumptions)
        assert sysid.load(result.save(tmp_path)).assumptions == result.assumptions


class TestToleranceOfGains:
    """Gains are off by about a per cent, as stated: what was taken off the records is no error of a part or a model."""

    GAINS = np.array([1.012, 0.99, 1.01, 0.995])

    @pytest.mark.parametrize("rng", [0, 1])
    def test_no_sensor_of_a_part_is_accused(self, rng):
        truth, sensors = block()
        test = shaken(truth, [dataclasses.replace(one, gain_std=0.01) for one in sensors], rng)
        test = dataclasses.replace(test, response=test.response * self.GAINS[:, None])
        assert not told(sysid.identify(Problem(test), rng=0))

    @pytest.mark.parametrize("soft", [False, True])
    def test_beside_a_diagonal_mass_of_whole_records_the_bracket_alone_is_told(self, soft):
        setting, rng = four_storeys(), np.random.default_rng(0)
        records, _ = setting.with_noise(setting.run(rng, 30.0).records(), rng)
        runs = [(records.base, records.response * self.GAINS[:, None], None)]
        test = sysid.Measurement.from_time(runs, records.sample_rate, rigid_body=np.ones((4, 1)), band=setting.lines)
        frequency = 4 * setting.structure.natural_frequencies[-1]
        if soft:
            test = on_bracket(test, 2, frequency)
        test = dataclasses.replace(test, gain_std=np.full(4, 0.01))
        found = told(sysid.identify(Problem(test, mass=LumpedMass(1940.0)), rng=0))
        assert len(found) == soft
        for _, value, std in found:
            assert abs(value - frequency) < max(4 * std, 0.02 * frequency)
