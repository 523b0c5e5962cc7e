"""Measurement, rigid_body and simulate: geometry by finite motions, definitions, noise statistics, refusals."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sysid import InputError, Measurement, Sensor, rigid_body, simulate

FREQ = np.linspace(2, 60, 40)


def complex_normal(rng, *shape):
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


@pytest.fixture
def records():
    """Plain random records: 3 runs, 2 base directions, 4 sensors, 5 lines."""
    rng = np.random.default_rng(0)
    return {
        "freq": np.array([1.0, 2.0, 4.0, 5.0, 8.0]),
        "base": complex_normal(rng, 3, 2, 5),
        "response": complex_normal(rng, 3, 4, 5),
        "force": complex_normal(rng, 3, 2, 5),
        "rigid_body": rng.uniform(-0.7, 0.7, (4, 2)),
    }


class TestRigidBody:
    @pytest.mark.parametrize("seed", range(5))
    def test_rows_are_the_derivative_of_a_finite_rigid_motion(self, seed):
        """Displacement along the axis, of a body moved and turned about the origin, by central differences."""
        rng = np.random.default_rng(seed)
        r, e, origin = rng.normal(size=(6, 3)), rng.normal(size=(6, 3)), rng.normal(size=3)
        unit = e / np.linalg.norm(e, axis=1, keepdims=True)

        def moved(q):
            places = origin + q[:3] + Rotation.from_rotvec(q[3:]).apply(r - origin)
            return np.sum((places - r) * unit, axis=1)

        h = 1e-5
        expected = np.column_stack([(moved(h * i) - moved(-h * i)) / (2 * h) for i in np.eye(6)])
        G = rigid_body(r, list(e), base_axes=["x", "y", "z", "rx", "ry", "rz"], origin=origin)
        np.testing.assert_allclose(G, expected, atol=1e-9)

    def test_strings_are_the_unit_vectors(self):
        axes = {"x": [1, 0, 0], "-x": [-1, 0, 0], "+y": [0, 1, 0], "-y": [0, -1, 0], "z": [0, 0, 1], "-z": [0, 0, -1]}
        r = np.random.default_rng(0).normal(size=(6, 3))
        full = ("x", "y", "z", "rx", "ry", "rz")
        np.testing.assert_array_equal(
            rigid_body(r, list(axes), base_axes=full), rigid_body(r, list(axes.values()), base_axes=full)
        )

    @pytest.mark.parametrize(
        ("short", "names"),
        [
            ("xyz", ["x", "y", "z"]), ("zx", ["z", "x"]), ("x", ["x"]), ("rz", ["rz"]), ("x rz", ["x", "rz"]),
            ("rx,ry", ["rx", "ry"]), ("y, rz", ["y", "rz"]), (("x", "ry"), ["x", "ry"]),
        ],
    )  # fmt: skip
    def test_forms_of_base_axes_pick_columns_in_their_order(self, short, names):
        rng = np.random.default_rng(1)
        r, e = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
        full = rigid_body(r, list(e), base_axes=["x", "y", "z", "rx", "ry", "rz"])
        columns = [["x", "y", "z", "rx", "ry", "rz"].index(name) for name in names]
        np.testing.assert_array_equal(rigid_body(r, list(e), base_axes=short), full[:, columns])

    def test_three_translations_by_default(self):
        np.testing.assert_array_equal(rigid_body([[1, 2, 3], [4, 5, 6]], ["y", "-z"]), [[0, 1, 0], [0, 0, -1]])

    @pytest.mark.parametrize("axis", ["w", "", "xx", "-", "--x", [0, 0, 0], [1, 0], [np.nan, 0, 1], [np.inf, 0, 1]])
    def test_axes_that_are_none(self, axis):
        with pytest.raises(InputError, match="axis"):
            rigid_body([[0, 0, 0]], [axis])

    @pytest.mark.parametrize("base_axes", ["", "w", "xx", [], ["x", "x"], ["r"], "x rw"])
    def test_base_axes_that_are_none(self, base_axes):
        with pytest.raises(InputError, match="base_axes"):
            rigid_body([[0, 0, 0]], ["x"], base_axes=base_axes)

    @pytest.mark.parametrize("positions", [[[0, 0, 0], [1, 1, 1]], [[0, 0]], [[1.0]], [[0, 0, 0, 0]]])
    def test_positions_that_do_not_fit(self, positions):
        with pytest.raises(InputError, match="positions"):
            rigid_body(positions, ["x"])


class TestRecords:
    def test_lie_in_memory_row_by_row_as_a_file_gives_them_back(self, records):
        """A reader fills time first: `records.T`; products of such arrays differ in their last bits."""
        turned = {name: np.asfortranarray(value) for name, value in records.items()}
        test = Measurement(**turned)
        assert not turned["response"].flags.c_contiguous
        assert all(getattr(test, name).flags.c_contiguous for name in records)

    def test_relative_takes_the_rigid_motion_off(self, records):
        test = Measurement(**records)
        for run in range(3):
            expected = records["response"][run] - records["rigid_body"] @ records["base"][run]
            np.testing.assert_allclose(test.relative[run], expected, rtol=1e-14)
        assert (test.n_runs, test.n_base, test.n_sensors) == (3, 2, 4)

    def test_one_run_may_come_without_its_axis(self, records):
        flat = {name: records[name][0] for name in ("base", "response", "force")}
        test = Measurement(**(records | flat))
        assert test.base.shape == (1, 2, 5)
        np.testing.assert_array_equal(test.response[0], records["response"][0])
        np.testing.assert_array_equal(test.force[0], records["force"][0])

    @pytest.mark.parametrize(
        "std", [0.5, [1, 2, 3, 4, 5], np.arange(1, 5)[:, None], np.arange(1, 4)[:, None, None], np.ones((3, 4, 5))]
    )
    def test_standard_deviations_broadcast(self, records, std):
        test = Measurement(**records, response_std=std, force_std=0.25)
        np.testing.assert_array_equal(test.response_std, np.broadcast_to(std, (3, 4, 5)))
        np.testing.assert_array_equal(test.force_std, np.full((3, 2, 5), 0.25))

    def test_in_band_keeps_the_lines_between_both_ends(self, records):
        G = records["rigid_body"]
        axes = np.column_stack([G[:, 1], G[:, 0], np.sqrt(1 - np.sum(G**2, axis=1))])
        test = Measurement(
            **records, response_std=np.ones(5), force_std=np.arange(5.0), base_axes="yx",
            sensors=[Sensor(str(i), (0, 0, i), axis) for i, axis in enumerate(axes.tolist())],
        )  # fmt: skip
        cut = test.in_band(2.0, 5.0)
        np.testing.assert_array_equal(cut.freq, [2, 4, 5])
        for name in ("base", "response", "force", "relative", "response_std", "force_std"):
            np.testing.assert_array_equal(getattr(cut, name), getattr(test, name)[..., 1:4])
        assert (cut.base_axes, cut.sensors) == (("y", "x"), test.sensors)
        with pytest.raises(InputError, match="no line between 2.5 and 3.5 Hz"):
            test.in_band(2.5, 3.5)

    def test_names_of_sensors(self, records):
        assert Measurement(**records).sensor_names == ("sensor 1", "sensor 2", "sensor 3", "sensor 4")
        alike = records | {"rigid_body": np.eye(2)[[0, 0, 0, 0]]}
        named = Measurement(**alike, sensors=[Sensor(name, (0, 0, 0), "x") for name in "abcd"])
        assert named.sensor_names == tuple("abcd")

    def test_predictions_are_the_structure_under_this_base_motion(self, records, random_structure):
        rng = np.random.default_rng(3)
        s = random_structure(rng, n=4, d=2)
        test = Measurement(**(records | {"rigid_body": s.rigid_body}))
        a, f = test.predict(s), test.predict_force(s)
        for run in range(3):
            for line, freq in enumerate(test.freq):
                u = test.base[run, :, line]
                np.testing.assert_allclose(a[run, :, line], s.relative_acceleration([freq])[..., 0] @ u, rtol=1e-12)
                np.testing.assert_allclose(f[run, :, line], s.base_force([freq])[..., 0] @ u, rtol=1e-12)
        ratio = np.linalg.norm(a - test.relative) / np.linalg.norm(test.relative)
        assert test.residual(s) == pytest.approx(ratio, rel=1e-12)
        ratio = np.linalg.norm(f - test.force) / np.linalg.norm(test.force)
        assert test.force_residual(s) == pytest.approx(ratio, rel=1e-12)
        assert dataclasses.replace(test, force=None, force_std=None).force_residual(s) is None
        with pytest.raises(InputError, match="the structure has"):
            test.predict(random_structure(rng, n=3, d=2))


class TestBaseAxes:
    def test_x_y_z_and_rotations_in_this_order_by_default(self, records):
        for d in (1, 2, 3, 4, 6):
            G = np.zeros((4, d))
            base = np.ones((1, d, 5))
            test = Measurement(records["freq"], base, records["response"][:1], rigid_body=G)
            assert test.base_axes == ("x", "y", "z", "rx", "ry", "rz")[:d]
            np.testing.assert_array_equal(test.translational, np.arange(d) < 3)

    def test_stated_axes(self, records):
        test = Measurement(**records, base_axes=["x", "ry"])
        np.testing.assert_array_equal(test.translational, [True, False])

    def test_a_lever_above_one_needs_its_axes_stated(self, records):
        G = records["rigid_body"] * 5
        with pytest.raises(InputError, match="state base_axes"):
            Measurement(**(records | {"rigid_body": G}))
        assert Measurement(**(records | {"rigid_body": G}), base_axes="x ry").base_axes == ("x", "ry")

    def test_refusals(self, records):
        with pytest.raises(InputError, match="names 3 directions but base has 2"):
            Measurement(**records, base_axes="xyz")
        with pytest.raises(InputError, match="base_axes"):
            Measurement(**records, base_axes="xq")
        with pytest.raises(InputError, match="at most six"):
            Measurement(records["freq"], np.ones((1, 7, 5)), records["response"][:1], rigid_body=np.zeros((4, 7)))


@pytest.mark.parametrize(
    ("match", "changes"),
    [
        ("freq must rise strictly: line 2", {"freq": [1, 2, 2, 3, 4]}),
        ("freq must rise strictly: line 3", {"freq": [1, 2, 5, 3, 4]}),
        ("negative line", {"freq": [-1, 2, 3, 4, 5]}),
        ("freq holds NaN", {"freq": [1, 2, np.nan, 4, 5]}),
        ("freq", {"freq": [[1, 2, 3, 4, 5]]}),
        ("freq", {"freq": []}),
        ("base has shape", {"base": np.ones((3, 2, 4))}),
        ("base has shape", {"base": np.ones(5)}),
        ("response has shape", {"response": np.ones((3, 4, 6))}),
        ("base has 3 runs but response has 2", {"response": np.ones((2, 4, 5))}),
        (r"rigid_body is \(2, 4\)", {"rigid_body": np.zeros((2, 4))}),
        ("rigid_body holds NaN", {"rigid_body": np.full((4, 2), np.nan)}),
        ("base is zero everywhere", {"base": np.zeros((3, 2, 5))}),
        ("base is not an array of numbers", {"base": "shake"}),
        ("force is", {"force": np.ones((3, 1, 5))}),
        ("force has shape", {"force": np.ones((3, 2, 4))}),
        ("2 sensors are described but response has 4", {"sensors": [Sensor("a", (0, 0, 0), "x")] * 2}),
        ("response_std.*does not broadcast", {"response_std": np.ones(4)}),
        ("response_std holds negative", {"response_std": -1.0}),
        ("response_std holds NaN", {"response_std": np.nan}),
        ("force_std.*does not broadcast", {"force_std": np.ones((3, 4, 5))}),
        ("force_std is given without", {"force_std": 1.0, "force": None}),
    ],
)
def test_bad_input_is_refused_by_name(records, match, changes):
    with pytest.raises(InputError, match=match):
        Measurement(**(records | changes))


@pytest.mark.parametrize("name", ["base", "response", "force"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1j * np.inf])
def test_samples_that_are_not_finite_are_counted_and_located(records, name, bad):
    value = records[name].copy()
    value[1, 1, 3] = bad
    with pytest.raises(InputError, match=rf"{name} holds NaN .*\(1 of {value.size}, the first at index \(1, 1, 3\)"):
        Measurement(**(records | {name: value}))


class TestFromFrf:
    @pytest.mark.parametrize("kind", ["ratios", "matrix"])
    def test_it_holds_what_simulate_holds(self, random_structure, kind):
        s = random_structure(np.random.default_rng(0), n=4, d=3, damping=kind)
        by_frf = Measurement.from_frf(FREQ, s.transmissibility(FREQ), rigid_body=s.rigid_body, force=s.base_force(FREQ))
        simulated = simulate(s, FREQ, force=True)
        for name in ("freq", "base", "response", "force", "rigid_body", "relative"):
            np.testing.assert_array_equal(getattr(by_frf, name), getattr(simulated, name))
        assert by_frf.base_axes == simulated.base_axes

    def test_run_j_is_unit_motion_in_direction_j(self, random_structure):
        s = random_structure(np.random.default_rng(1), n=3, d=2)
        H, F = s.transmissibility(FREQ), s.base_force(FREQ) + 0.1j * np.arange(2)[:, None, None]
        test = Measurement.from_frf(FREQ, H, rigid_body=s.rigid_body, force=F)
        for j in range(2):
            np.testing.assert_array_equal(test.base[j], np.eye(2)[j][:, None] * np.ones(FREQ.size))
            np.testing.assert_array_equal(test.response[j], H[:, j])
            np.testing.assert_array_equal(test.force[j], F[:, j])

    def test_standard_deviations_follow_their_function(self):
        rng = np.random.default_rng(2)
        H, F, G = complex_normal(rng, 3, 2, 5), complex_normal(rng, 2, 2, 5), np.zeros((3, 2))
        std, force_std = rng.uniform(1, 2, (3, 2, 1)), rng.uniform(1, 2, (2, 2, 5))
        freq = np.arange(1, 6)
        test = Measurement.from_frf(freq, H, rigid_body=G, force=F, response_std=std, force_std=force_std)
        for j in range(2):
            np.testing.assert_array_equal(test.response_std[j], np.broadcast_to(std[:, j], (3, 5)))
            np.testing.assert_array_equal(test.force_std[j], force_std[:, j])

    @pytest.mark.parametrize(
        ("match", "changes"),
        [
            ("frf has shape", {"frf": np.ones((3, 2, 4))}),
            ("force is", {"force": np.ones((3, 2, 5))}),
            ("force has shape", {"force": np.ones((2, 2, 3))}),
            ("rigid_body", {"rigid_body": np.zeros((2, 2))}),
            ("frf holds", {"frf": np.full((3, 2, 5), np.nan)}),
            ("response_std", {"response_std": np.ones((3, 3, 5))}),
            ("force_std", {"force_std": 1.0}),
            ("freq", {"freq": [5, 4, 3, 2, 1]}),
        ],
    )
    def test_refusals(self, match, changes):
        good = {"freq": np.arange(1, 6), "frf": np.ones((3, 2, 5)), "rigid_body": np.zeros((3, 2))}
        with pytest.raises(InputError, match=match):
            Measurement.from_frf(**(good | changes))


class TestSimulate:
    @pytest.mark.parametrize("seed", range(4))
    def test_noise_has_the_stated_level_for_each_kind_of_record_apart(self, random_structure, seed):
        """N squared magnitudes of circular noise average to noise² mean|record|² within 4 / sqrt(N) (4 sigma)."""
        s = random_structure(np.random.default_rng(seed), n=4, d=2, base_mass=50.0)
        freq = np.linspace(1, 70, 2500)
        clean, noisy = simulate(s, freq, force=True), simulate(s, freq, noise=0.05, force=True, rng=seed)
        for name in ("response", "force"):
            truth = getattr(clean, name)
            e = getattr(noisy, name) - truth
            level = 0.05**2 * np.mean(np.abs(truth) ** 2)
            within = 4 / np.sqrt(e.size)
            assert np.mean(np.abs(e) ** 2) / level == pytest.approx(1, abs=within)
            assert abs(np.mean(e**2)) / level < within * np.sqrt(2)  # circular: no preferred phase
            assert abs(np.mean(e)) / np.sqrt(level) < within
            np.testing.assert_allclose(getattr(noisy, f"{name}_std"), np.sqrt(level), rtol=1e-12)
            # The same on every channel, however weak its record.
            per_channel = np.mean(np.abs(e) ** 2, axis=(0, 2)) / level
            assert np.all(np.abs(per_channel - 1) < 5 / np.sqrt(2 * freq.size))
        np.testing.assert_array_equal(noisy.base, clean.base)

    def test_without_noise_it_is_the_structure(self, random_structure):
        s = random_structure(np.random.default_rng(0), n=4, d=2)
        test = simulate(s, FREQ)
        np.testing.assert_array_equal(np.moveaxis(test.response, 0, 1), s.transmissibility(FREQ))
        assert test.force is None and test.response_std is None and test.force_std is None
        assert test.residual(s) < 1e-14

    def test_the_noise_floor_is_the_residual_of_the_truth(self, random_structure):
        s = random_structure(np.random.default_rng(0), n=4, d=2)
        test = simulate(s, FREQ, noise=0.01, rng=1)
        e = test.response - simulate(s, FREQ).response
        assert test.residual(s) == pytest.approx(np.linalg.norm(e) / np.linalg.norm(test.relative), rel=1e-9)

    def test_one_seed_gives_the_same_bits(self, random_structure):
        s = random_structure(np.random.default_rng(0), n=3, d=2)
        first, again, generator, other = (
            simulate(s, FREQ, noise=0.1, force=True, rng=rng) for rng in (7, 7, np.random.default_rng(7), 8)
        )
        for name in ("response", "force"):
            np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
            np.testing.assert_array_equal(getattr(first, name), getattr(generator, name))
            assert np.all(getattr(first, name) != getattr(other, name))

    def test_asking_for_the_force_leaves_the_responses_as_they_are(self, random_structure):
        s = random_structure(np.random.default_rng(0), n=3, d=2)
        with_force, without = (simulate(s, FREQ, noise=0.1, force=force, rng=3) for force in (True, False))
        np.testing.assert_array_equal(with_force.response, without.response)

    @pytest.mark.parametrize("noise", [-0.1, np.nan, np.inf])
    def test_noise_that_is_none(self, random_structure, noise):
        with pytest.raises(InputError, match="noise"):
            simulate(random_structure(np.random.default_rng(0)), FREQ, noise=noise)

    def test_base_axes_are_carried(self, random_structure):
        s = random_structure(np.random.default_rng(0), n=3, d=2)
        assert simulate(s, FREQ, base_axes="x ry").base_axes == ("x", "ry")
