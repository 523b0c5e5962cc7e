"""Each doubt about a fit is said where it must be, and only there."""

import dataclasses

import casadi as ca
import numpy as np
import pytest

import sysid
from benchmarks.records.simulated import four_storeys
from sysid import FullMass, KnownMass, LumpedMass, Measurement, Problem, Structure, simulate
from sysid.assessment.checks.against_records import _of_one_sensor, records_of_fit
from sysid.assessment.checks.context import Context, run
from sysid.assessment.checks.stated import missed_values, stated_masses
from sysid.search.strategy import Outcome

pytestmark = pytest.mark.usefixtures("from_one_start_in_module")


def doubts(problem, structure, x):
    """Findings against a search that ended there, by the stated values and the records."""
    end = Outcome(structure, x, "made by hand", True, "", sysid.History())
    return run(Context(problem.prepared, end), (stated_masses, missed_values, records_of_fit))


def kinds(findings):
    return [one.kind for one in findings]


def lines(truth, count=240):
    f = truth.natural_frequencies
    return np.geomspace(0.5 * f[0], 1.3 * f[-1], count)


def building(dashpot=0.0):
    """Three storeys on a light foundation; N s/m of a dashpot between floors 2 and 3 beside 1 % in all modes."""
    m, k = 4.0, 5000.0
    K = k * np.array([[2.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    full = np.block([[K, -K.sum(axis=1, keepdims=True)], [-K.sum(axis=1)[None], K.sum(keepdims=True)]])
    M = np.diag([m, m, m, 1.0])
    plain = Structure(M, full, np.full(3, 0.01), n_base=1)
    between = np.array([0.0, -1.0, 1.0])
    return Structure(M, full, n_base=1, damping_matrix=plain.damping + dashpot * np.outer(between, between))


def changed(test, **changes):
    values = {
        "response": test.response, "force": test.force, "rigid_body": test.rigid_body,
        "response_std": test.response_std, "force_std": test.force_std,
    } | changes  # fmt: skip
    return Measurement(test.freq, test.base, values.pop("response"), base_axes=test.base_axes, **values)


def said(test, structure, mass=None):
    given = sysid.SpectralStiffness(structure.natural_frequencies, max_frequency=2 * structure.natural_frequencies[-1])
    return doubts(Problem(test, mass=FullMass() if mass is None else mass, stiffness=given), structure, None)


def modal_twin(truth):
    """The same with the modal damping ratios that it has."""
    return Structure(truth.mass, truth.stiffness, truth.damping_ratios, n_base=truth.n_base)


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01, 0.1])
@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_a_good_fit_of_a_structure_of_the_models_kind_leaves_none(random_structure, seed, force, noise):
    rng = np.random.default_rng(seed)
    truth = random_structure(rng, n=4, d=int(rng.integers(1, 4)))
    assert said(simulate(truth, lines(truth), noise=noise, force=force, rng=rng), truth) == []


class TestDamping:
    @pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
    def test_a_dashpot_between_floors_is_told(self, noise):
        truth = building(dashpot=25.0)
        (doubt,) = said(simulate(truth, lines(truth), noise=noise, rng=0), modal_twin(truth))
        assert doubt.kind == "damping" and doubt.numbers["share"] > 3 * noise

    @pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
    def test_a_damping_matrix_that_is_modal_is_not(self, noise):
        truth = building()
        assert said(simulate(truth, lines(truth), noise=noise, rng=0), modal_twin(truth)) == []

    def test_what_noise_hides_is_not_told(self):
        truth = building(dashpot=0.05)
        assert said(simulate(truth, lines(truth), noise=0.05, rng=0), modal_twin(truth)) == []

    def test_the_identified_structure_has_the_dashpot_in_its_damping_matrix(self):
        truth = building(dashpot=25.0)
        test = simulate(truth, lines(truth), noise=0.001, force=True, rng=0)
        result = sysid.identify(Problem(test, mass=FullMass()), rng=0)
        assert result.structure.n == 3 and not result.structure.modal_damping
        off = np.abs(result.structure.damping - truth.damping) / result.uncertainty.damping
        assert off.max() < 4 and np.all(result.uncertainty.damping < 0.1 * truth.damping.max())
        assert result.determined and not result.contradictions
        (note,) = result.of_kind("damping")
        assert note.severity == "note" and note.numbers["deviations"] > 10
        inverse = np.linalg.inv(truth.mass[:3, :3])
        A = np.block([[np.zeros((3, 3)), np.eye(3)], [-inverse @ truth.stiffness[:3, :3], -inverse @ truth.damping]])
        poles = np.unique(np.abs(np.linalg.eigvals(A)).round(9)) / (2 * np.pi)
        np.testing.assert_allclose([note.numbers[f"pole {at}"] for at in (1, 2, 3)], poles, rtol=1e-3)
        assert np.max(np.abs(poles / truth.natural_frequencies - 1)) > 3e-3  # which the table has

    def test_without_a_force_it_is_doubted_and_not_called_known(self):
        truth = building(dashpot=25.0)
        test = simulate(truth, lines(truth), noise=0.001, rng=0)
        result = sysid.identify(Problem(test, mass=FullMass()), rng=0)
        assert result.structure.n == 3
        assert not result.determined
        assert "damping" in kinds(result.contradictions) and result.judgement == "no fit"


class TestForce:
    @pytest.mark.parametrize("noise", [0.0, 0.01])
    @pytest.mark.parametrize("factor", [0.001, 1 / 9.81, 9.81])
    def test_another_unit_is_told(self, random_structure, factor, noise):
        """Modes and rigid-body mass of the structure are right, its force is in kN or kgf."""
        truth = random_structure(np.random.default_rng(0), n=3, d=2)
        test = simulate(truth, lines(truth), noise=noise, force=True, rng=1)
        (doubt,) = said(changed(test, force=test.force * factor, force_std=None), truth)
        assert doubt.kind == "force misfit" and doubt.numbers["misfit"] > 1.5 * doubt.numbers["free residues"]

    def test_so_is_another_axis(self, random_structure):
        truth = random_structure(np.random.default_rng(0), n=3, d=2)
        test = simulate(truth, lines(truth), noise=0.01, force=True, rng=1)
        assert "force misfit" in kinds(said(changed(test, force=test.force[:, ::-1]), truth))

    @pytest.mark.parametrize("mass", ["full", "lumped", "known"])
    @pytest.mark.parametrize("noise", [0.0, 0.01])
    def test_a_stated_mass_that_it_contradicts_is_told(self, mass, noise):
        truth = modal_twin(building())
        test = simulate(truth, lines(truth), noise=noise, force=True, rng=2)
        heavy = Structure(2 * truth.mass, 2 * truth.stiffness, truth.damping_ratios, n_base=1)
        model = {
            "full": FullMass(26.0, healing="rigid_body"), "lumped": LumpedMass(24.0), "known": KnownMass(heavy.mass)
        }[mass]  # fmt: skip
        (stated,) = [one for one in said(test, heavy, model) if one.kind == "stated mass"]
        assert stated.numbers["stated 1"] == pytest.approx(26.0)
        assert stated.numbers["weighed 1"] == pytest.approx(13.0, rel=max(1e-3, noise))

    @pytest.mark.parametrize("noise", [0.0, 0.01, 0.1])
    def test_one_that_it_agrees_with_is_not(self, noise):
        truth = modal_twin(building())
        test = simulate(truth, lines(truth), noise=noise, force=True, rng=2)
        for model in (FullMass(13.0, healing="rigid_body"), FullMass(13.0), KnownMass(truth.mass)):
            assert said(test, truth, model) == []

    @pytest.mark.parametrize("seed", range(4))
    def test_nor_is_noise_that_is_stated_to_gather_at_the_peaks(self, random_structure, seed):
        """As that of an estimate by segments does: there the truth misses most, and rightly."""
        rng = np.random.default_rng(seed)
        truth = random_structure(rng, n=4, d=2)
        clean = simulate(truth, lines(truth), noise=0.01, rng=rng, force=True)
        size = np.linalg.norm(clean.force, axis=(0, 1))
        std = np.broadcast_to(0.05 * size**2 / size.max(), clean.force.shape)
        noise = std * (rng.normal(size=std.shape) + 1j * rng.normal(size=std.shape)) / np.sqrt(2)
        noisy = changed(clean, force=clean.force + noise, force_std=std)
        assert said(noisy, truth) == []
        wrong = changed(noisy, force=noisy.force / 9.81, force_std=std / 9.81)
        assert len(said(wrong, truth)) == 1


@pytest.mark.parametrize("noise", [0.0, 0.005])
@pytest.mark.parametrize(("share", "is_told"), [(0.3, True), (0.0, False)])
def test_a_sensor_that_moves_with_the_base_beside_its_modes_is_told_by_how_much(noise, share, is_told):
    """The second floor records 30 % of the base's motion more than it makes: neither modes nor G hold that."""
    truth = building()
    test = simulate(truth, lines(truth), noise=noise, rng=2)
    wrong = changed(test, response=test.response + share * np.array([0.0, 1.0, 0.0])[:, None] * test.base)
    found = [one for one in said(wrong, truth) if one.kind == "rigid motion"]
    assert [one.channel for one in found] == ["sensor 2"] * is_told
    for one in found:
        assert one.numbers["times"] == pytest.approx(share, rel=0.05)
        assert (one.numbers["direction"], one.numbers["sensors"]) == (1, 1)


class TestModesBelow:
    """Lines begin above the first mode, which answers there like a constant."""

    @staticmethod
    def above_the_first(truth, **given):
        f = truth.natural_frequencies
        freq = np.geomspace(f[0] + 0.5 * (f[1] - f[0]), 1.3 * f[-1], 240)
        return simulate(truth, freq, force=True, **given)

    @pytest.mark.parametrize("total", [None, 13.0])
    def test_neither_sensors_nor_a_stated_mass_are_judged_and_that_is_said(self, total):
        truth = building()
        test = self.above_the_first(truth, noise=0.003, rng=0)
        result = sysid.identify(Problem(test, mass=FullMass(total, healing="rigid_body")), rng=0)
        (told,) = result.of_kind("modes below")
        assert told.severity == "note" and told.numbers["modes"] == 1
        assert told.numbers["lowest"] == pytest.approx(truth.natural_frequencies[0], rel=0.05)
        assert not result.contradictions and np.all(np.isnan(result.gains.error))
        np.testing.assert_allclose(result.structure.natural_frequencies, truth.natural_frequencies[1:], rtol=1e-3)
        force = result.structure.base_force(test.freq)
        assert np.linalg.norm(force - truth.base_force(test.freq)) < 0.003 * np.linalg.norm(force)

    def test_most_sensors_that_move_with_the_base_are_of_a_mode_without_a_pole(self):
        """The answer knows nothing of the first mode, and no single sensor is named."""
        truth = building()
        test = self.above_the_first(truth)
        P = np.linalg.inv(truth.mode_shapes)
        K = (P.T * (2 * np.pi * np.array([1e4, *truth.natural_frequencies[1:]])) ** 2) @ P
        full = np.block([[K, -K.sum(axis=1, keepdims=True)], [-K.sum(axis=1)[None], K.sum(keepdims=True)]])
        found = said(test, Structure(truth.mass, full, truth.damping_ratios, n_base=1))
        told = [one for one in found if one.kind in ("modes below", "rigid motion")]
        assert [(one.kind, one.channel, one.severity) for one in told] == [("modes below", None, "contradicts")]
        assert told[0].numbers["sensors"] == 3

    def test_nothing_is_said_where_the_lines_begin_below_all_modes(self):
        truth = building()
        result = sysid.identify(Problem(simulate(truth, lines(truth), noise=0.003, rng=0), mass=FullMass()), rng=0)
        assert not result.of_kind("modes below")


class TestTwins:
    @staticmethod
    def with_twin(sign, noise, *, apart=0.0):
        """Four sensors of the building, the last beside the third, of either polarity; noise on each of its own."""
        truth = modal_twin(building())
        recovery = np.vstack([np.eye(3), [0.0, apart, sign * (1 - apart)]])
        wide = Structure(
            truth.mass, truth.stiffness, truth.damping_ratios, n_base=1, recovery=recovery,
            rigid_body=recovery @ truth.rigid_body,
        )  # fmt: skip
        return simulate(wide, lines(truth), noise=noise, rng=3), wide

    @pytest.mark.parametrize("sign", [1, -1])
    @pytest.mark.parametrize("noise", [0.0, 0.001, 0.03])
    def test_two_sensors_that_are_one_are_named(self, sign, noise):
        test, structure = self.with_twin(sign, noise)
        (twins,) = [one for one in said(test, structure) if one.kind == "one motion"]
        assert (twins.channel, twins.numbers["sensor"], twins.numbers["other"]) == ("sensor 3", 2, 3)

    @pytest.mark.parametrize("noise", [0.0, 0.001, 0.01])
    def test_neighbours_are_not(self, noise):
        test, structure = self.with_twin(1, noise, apart=0.2)
        assert "one motion" not in kinds(said(test, structure))

    @pytest.mark.parametrize("stated", [True, False])
    @pytest.mark.parametrize(("times", "count"), [(2.5, 0), (30.0, 0), (0.1, 1)])
    def test_nor_are_floors_on_a_stiff_storey_that_differ_by_more_than_noise(self, times, count, stated):
        """By so many times the noise, in the mean over the lines."""
        k, stiff = 5000.0, 400_000.0
        K = np.array([[2 * k, -k, 0], [-k, k + stiff, -stiff], [0, -stiff, stiff]])
        full = np.block([[K, -K.sum(axis=1, keepdims=True)], [-K.sum(axis=1)[None], K.sum(keepdims=True)]])
        truth = Structure(np.diag([4.0, 4.0, 4.0, 1.0]), full, np.full(3, 0.01), n_base=1)
        freq = np.linspace(2.0, 12.0, 300)
        clean = simulate(truth, freq)
        apart = clean.response[0, 2] - clean.response[0, 1]
        std = np.sqrt(np.mean(np.abs(apart) ** 2) / 2) / times  # two sensors
        rng = np.random.default_rng(0)
        noise = std * np.sqrt(0.5) * (rng.normal(size=(1, 3, 300)) + 1j * rng.normal(size=(1, 3, 300)))
        test = changed(clean, response=clean.response + noise, response_std=std if stated else None)
        found = [one for one in said(test, truth) if one.kind == "one motion"]
        assert [(one.channel, one.numbers["other"]) for one in found] == [("sensor 2", 2)] * count

    @pytest.mark.parametrize(("top", "count"), [(3e7, 0), (1e9, 1)])
    def test_whole_records_judge_by_the_noise_that_they_show(self, top, count):
        """Floors 3 and 4 of four storeys, 40 s cut in motion, 50 and 1,700 times as stiff between as usual."""
        setting = four_storeys(top=top)
        rng = np.random.default_rng(0)
        noisy, _ = setting.with_noise(setting.run(rng, 40.0).records(), rng)
        test = Measurement.from_time(
            [(noisy.base, noisy.response, noisy.force)], noisy.sample_rate, rigid_body=np.ones((4, 1)), band=(1.0, 20.0)
        )
        found = sysid.identify(Problem(test, mass=FullMass()), rng=0)
        assert found.structure.n == 3
        assert [one.channel for one in found.of_kind("one motion")] == ["sensor 3"] * count

    def test_one_that_is_no_degree_of_freedom_does_no_harm(self):
        """Three modes, two sensors in one motion: with fewer sensors than modes there are modal coordinates anyway."""
        truth = modal_twin(building())
        recovery = np.eye(3)[[2, 2]]
        wide = Structure(
            truth.mass, truth.stiffness, truth.damping_ratios, n_base=1, recovery=recovery,
            rigid_body=recovery @ truth.rigid_body,
        )  # fmt: skip
        test = simulate(wide, lines(truth), noise=0.001, force=True, rng=3)
        found = sysid.identify(Problem(test, mass=FullMass()), rng=0)
        assert found.structure.n == 3
        assert np.count_nonzero(found.structure.dof_sensors >= 0) == 1
        assert [one.severity for one in found.of_kind("one motion")] == ["note"]
        assert found.determined

    def test_nor_are_sensors_that_both_record_nothing_but_noise(self):
        test, structure = self.with_twin(1, 0.001)
        rng = np.random.default_rng(0)
        response = test.response.copy()
        noise = 1e-3 * (rng.normal(size=(2, test.freq.size)) + 1j * rng.normal(size=(2, test.freq.size)))
        # Two feet of the frame, which move with the base.
        response[0, [0, 3]] = test.rigid_body[[0, 3]] * test.base[0] + noise
        assert "one motion" not in kinds(said(changed(test, response=response), structure))


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("stated", [20.0, 30.0])
def test_a_model_whose_poles_are_not_those_of_the_data_is_told(stated, noise):
    """One mass on an unknown spring, its damper of 20 N s/m stated rightly, or as 30: free residues at the model's
    own poles then miss as much as the model does.
    """
    freq, rng = np.linspace(2.0, 20.0, 100), np.random.default_rng(0)
    w = 2 * np.pi * freq
    a = 5 * w**2 / (2e4 - 5 * w**2 + 20j * w)
    a += noise * np.sqrt(np.mean(np.abs(a) ** 2) / 2) * (rng.normal(size=w.size) + 1j * rng.normal(size=w.size))
    k = sysid.Variable("spring", lower=5e3, upper=8e4, guess=1.9e4)
    test = Measurement(freq, np.ones((1, w.size)), (1 + a)[None, None], rigid_body=[[1.0]])
    problem = Problem(
        test, mass=np.diag([5.0, 0.0]), stiffness=k * np.array([[1.0, -1.0], [-1.0, 1.0]]), damping=[[stated]]
    )
    result = sysid.identify(problem, strategy=sysid.Continuation(starts=1), rng=0)
    assert result.success
    if stated == 20.0:
        assert result.determined
    else:
        (doubt,) = (*result.contradictions, *result.open_findings)
        assert doubt.kind == "misfit" and doubt.numbers["misfit"] > 1.5 * doubt.numbers["poles of the data"]
        assert result.judgement == "doubtful"


class TestOneListForEveryProblem:
    """The same checks for a problem in variables, of further tests, and of priors."""

    def chain(self, truth, test, **options):
        k = sysid.Variable("k", 3, lower=1e2, upper=1e6, guess=5000.0)
        T = np.array([[1.0, 0, 0, -1.0], [-1.0, 1.0, 0, 0], [0, -1.0, 1.0, 0]])
        return Problem(test, mass=truth.mass, stiffness=T.T @ ca.diag(k) @ T, damping=[0.01] * 3, **options), k

    def test_a_known_mass_with_a_written_stiffness_is_weighed_too(self):
        truth = modal_twin(building())
        test = simulate(truth, lines(truth), force=True)
        x = np.full(3, 5000.0)
        problem, _ = self.chain(truth, test)
        assert doubts(problem, problem.structure(x), x) == []
        heavy, _ = self.chain(truth, changed(test, force=test.force / 2))
        told = doubts(heavy, heavy.structure(x), x)
        (mass,) = [one for one in told if one.kind == "stated mass"]
        assert mass.numbers == pytest.approx({"stated 1": 13.0, "weighed 1": 6.5})

    def test_each_test_is_checked_under_its_number(self):
        truth = modal_twin(building())
        M, C = truth.mass, truth.damping
        test = simulate(Structure(M, truth.stiffness, n_base=1, damping_matrix=C), lines(truth))
        flipped = test.response.copy()
        flipped[:, 1] *= -1
        for response in (test.response, flipped):
            k = sysid.Variable("k", lower=0.5, upper=2.0, guess=1.0)
            second = sysid.FurtherTest(
                changed(test, response=response), mass=M, stiffness=k * truth.stiffness, damping=C
            )
            problem = Problem(test, mass=M, stiffness=k * truth.stiffness, damping=C, residuals=[second])
            told = doubts(problem, problem.structure(np.ones(1)), np.ones(1))
            if response is flipped:
                assert told and all(one.numbers["test"] == 2 for one in told)
                assert any(one.channel == "sensor 2" for one in told)
            else:
                assert told == []

    def test_priors_are_checked_one_by_one_and_together(self):
        truth = modal_twin(building())
        test = simulate(truth, lines(truth))
        x = np.full(3, 5000.0)

        def told(*off):
            problem, k = self.chain(truth, test)
            priors = [sysid.Prior(k[i], 5000.0 - 100.0 * z, 100.0) for i, z in enumerate(off)]
            problem = dataclasses.replace(problem, residuals=priors)
            return doubts(problem, problem.structure(x), x)

        assert told(1.0, -1.0, 2.0) == []
        (alone,) = told(4.5, 0.0, 0.0)
        assert alone.kind == "stated value" and alone.numbers == pytest.approx({"k[0]": 4.5})
        # The chi-squared law of 3: a sum of squares of 16.3 is exceeded by chance in one of 1 000.
        assert told(2.3, 2.3, 2.3) == []
        (together,) = told(2.4, -2.4, 2.4)
        assert together.kind == "stated values"
        assert together.numbers == pytest.approx({"k[0]": 2.4, "k[1]": -2.4, "k[2]": 2.4})

    def test_of_a_misfit_of_the_users_own_the_records_are_not_checked(self):
        truth = modal_twin(building())
        test = simulate(truth, lines(truth))
        problem, k = self.chain(truth, changed(test, response=-test.response))
        x = np.full(3, 5000.0)
        assert doubts(problem, problem.structure(x), x)
        own = dataclasses.replace(problem, misfit=k - 5000.0)
        assert doubts(own, own.structure(x), x) == []


class TestModesBelowTheLines:
    FREQ = np.linspace(10.0, 100.0, 50)

    def test_those_of_one_sensor_alone_are_its_share_of_the_motion_of_the_base(self):
        """What they add to its transmissibility, far above them."""
        f, zeta, shape, load = np.array([0.3]), np.array([0.4]), np.array([0.01, -2.0, 0.02]), np.array([[0.6, -0.3]])
        share = _of_one_sensor(sysid.ResidualModes(f, zeta, shape[:, None], load), self.FREQ)
        r = self.FREQ / f
        adds = -2.0 * load * (r**2 / (1 - r**2 + 2j * zeta * r))[:, None]  # of a single degree of freedom, relative
        np.testing.assert_allclose(share[1], adds[-1].real, rtol=2e-5)
        assert not np.any(share[[0, 2]])

    @pytest.mark.parametrize(
        "shape, f", [([0.3, -2.0, 0.3], 0.3), ([0.0, -2.0, 0.0], 1.1), ([0.0, -2.0], 0.3)],
        ids=["others move", "not far below", "two sensors"],
    )  # fmt: skip
    def test_others_tell_of_no_sensor(self, shape, f):
        mode = sysid.ResidualModes(np.array([f]), np.array([0.4]), np.array(shape)[:, None], np.ones((1, 2)))
        assert not np.any(_of_one_sensor(mode, self.FREQ))
