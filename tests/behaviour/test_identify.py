"""identify: strategies, seeds, budgets, ways to stop, and what the result carries."""

import dataclasses
import json
import signal
import time

import numpy as np
import pytest

import sysid
from sysid import FullMass, Identification, InputError, Problem, Swarm, identify

QUICK = Swarm(max_iterations=8, n_particles=20)
SWARM_ONLY = Swarm(max_iterations=8, n_particles=20, local=None)


@pytest.fixture
def case(random_case):
    return random_case(np.random.default_rng(0), "rigid_body", n=3, d=1)


@pytest.fixture
def problem(case):
    return case[1]


def same_bits(a, b):
    np.testing.assert_array_equal(a.x, b.x)
    for name in ("mass", "stiffness", "damping"):
        np.testing.assert_array_equal(getattr(a.structure, name), getattr(b.structure, name))
    assert a.residual == b.residual


class TestStrategy:
    @pytest.mark.parametrize(("strategy", "taken"), [("swarm", "swarm"), ("modal", "modal"), ("auto", "modal")])
    def test_the_named_strategies_run_the_whole_way(self, problem, strategy, taken):
        result = identify(problem, strategy=strategy, rng=0)
        assert isinstance(result, Identification)
        assert result.strategy == taken
        assert result.seed == 0
        assert result.success
        assert result.message.startswith("IPOPT: ")
        assert result.residual < 1e-6
        assert result.structure.natural_frequencies == pytest.approx(problem.reference.natural_frequencies, rel=1e-6)

    @pytest.mark.parametrize("strategy", ["magic", "", "Swarm"])
    def test_unknown(self, problem, strategy):
        with pytest.raises(
            InputError,
            match=f"'{strategy}' is unknown; give one of 'auto', 'modal', 'continuation', 'swarm', 'hpso-ls'$",
        ):
            identify(problem, strategy=strategy)

    def test_something_else(self, problem):
        with pytest.raises(InputError, match="strategy"):
            identify(problem, strategy=3)

    def test_without_refinement_the_spectrum_is_free(self, problem):
        result = identify(problem, strategy=Swarm(max_iterations=5, refine=False, local=None), rng=0)
        assert np.isnan(result.history.refinement_error)
        given = problem.reference.natural_frequencies
        assert np.max(np.abs(result.structure.natural_frequencies / given - 1)) > 1e-3
        refined = identify(problem, strategy=Swarm(max_iterations=5, local=None), rng=0)
        np.testing.assert_allclose(refined.structure.natural_frequencies, given, rtol=1e-8)
        assert refined.history.refinement_error < 1e-8

    def test_gradients_every_few_iterations_help_the_swarm(self, problem):
        plain = identify(problem, strategy=SWARM_ONLY, rng=1)
        helped = identify(
            problem, strategy=Swarm(max_iterations=8, n_particles=20, gradient_every=3, local=None), rng=1
        )
        assert helped.history.swarm < plain.history.swarm
        assert len(helped.history.swarm_curve) == 8

    @pytest.mark.parametrize(
        ("mass", "stiffness", "damping"), [("lumped", "chain", "proportional"), ("known", "chain", "modal")]
    )
    def test_models_without_a_spectrum_skip_the_refinement(self, random_case, mass, stiffness, damping):
        """No frequency is given: other minima abound, and with a goal one of many swarms finds the truth."""
        truth, problem = random_case(np.random.default_rng(3), mass, stiffness, damping, n=2, d=1)
        problem = dataclasses.replace(problem, goal=1e-6)
        result = identify(problem, strategy=Swarm(max_iterations=60, restarts=30), rng=0)
        assert np.isnan(result.history.refinement_error)
        assert not any("eigenvalues" in line for line in result.history.log)
        assert result.residual < 1e-6
        np.testing.assert_allclose(result.structure.stiffness[:2, :2], truth.stiffness[:2, :2], rtol=1e-4)


class TestSeeds:
    @pytest.mark.parametrize("seed", [0, 123456789])
    def test_one_seed_gives_the_same_bits(self, problem, seed):
        first, again = (identify(problem, strategy=QUICK, rng=seed) for _ in range(2))
        same_bits(first, again)
        np.testing.assert_array_equal(first.history.swarm_curve, again.history.swarm_curve)
        np.testing.assert_array_equal(first.history.local_curve, again.history.local_curve)
        other = identify(problem, strategy=QUICK, rng=seed + 1)
        assert np.any(first.history.swarm_curve != other.history.swarm_curve)

    def test_listening_changes_nothing(self, problem):
        quiet = identify(problem, strategy=QUICK, rng=1)
        loud = identify(problem, strategy=QUICK, rng=1, callback=lambda _: None, progress=str)
        same_bits(quiet, loud)

    def test_a_generator_gives_a_seed_that_repeats_the_run(self, problem):
        result = identify(problem, strategy=SWARM_ONLY, rng=np.random.default_rng(5))
        twin = identify(problem, strategy=SWARM_ONLY, rng=np.random.default_rng(5))
        same_bits(result, twin)
        same_bits(result, identify(problem, strategy=SWARM_ONLY, rng=result.seed))

    def test_none_draws_a_seed_and_reports_it(self, problem):
        result = identify(problem, strategy=SWARM_ONLY)
        assert isinstance(result.seed, int)
        same_bits(result, identify(problem, strategy=SWARM_ONLY, rng=result.seed))

    @pytest.mark.parametrize("rng", [-1, 1.5, "7"])
    def test_seeds_that_are_none(self, problem, rng):
        with pytest.raises(InputError, match="rng"):
            identify(problem, rng=rng)


class TestStart:
    def test_the_truth_as_a_structure_is_where_the_swarm_begins(self, case):
        truth, problem = case
        result = identify(problem, strategy=SWARM_ONLY, rng=0, start=truth)
        # Through the sampling transform, whose inverse is steep at the bounds; the box excludes nothing of this truth.
        assert result.history.start < 0.05
        free = identify(problem, strategy=SWARM_ONLY, rng=0)
        assert result.history.start < free.history.start
        assert result.residual <= result.history.start + 1e-9

    def test_unknowns_as_a_start(self, case):
        truth, problem = case
        x = problem.values(truth)
        result = identify(problem, strategy=SWARM_ONLY, rng=0, start=x)
        same_bits(result, identify(problem, strategy=SWARM_ONLY, rng=0, start=truth))

    def test_starts_that_do_not_fit(self, problem, random_structure):
        for bad in (np.ones(3), np.full(problem.n_variables, np.nan), 1.0):
            with pytest.raises(InputError, match="start"):
                identify(problem, start=bad)
        for n, d in ((5, 1), (2, 2)):  # the second has as many rows in all
            with pytest.raises(InputError, match="start"):
                identify(problem, start=random_structure(np.random.default_rng(0), n=n, d=d))


class TestBudgets:
    def test_evaluations_are_never_passed(self, problem):
        result = identify(problem, strategy=Swarm(n_particles=20, local=None), rng=0, max_evaluations=75)
        assert 20 <= result.history.evaluations <= 75

    def test_too_few_evaluations_for_one_swarm(self, problem):
        with pytest.raises(InputError, match="max_evaluations"):
            identify(problem, strategy=QUICK, max_evaluations=10)

    def test_time(self, problem):
        begun = time.perf_counter()
        endless = Swarm(max_iterations=10**6, stall_iterations=10**6)
        result = identify(problem, strategy=endless, rng=0, max_time=1.0)
        assert time.perf_counter() - begun < 6
        assert np.isfinite(result.residual)
        assert np.isfinite(result.history.local)  # a third of the time is left to the local phase

    @pytest.mark.parametrize("bad", [0, -1.0, np.nan])
    def test_times_that_are_none(self, problem, bad):
        with pytest.raises(InputError, match="max_time"):
            identify(problem, max_time=bad)


class TestGoal:
    def with_goal(self, problem, goal):
        return Problem(
            problem.measurement, mass=problem.mass, stiffness=problem.stiffness, damping=problem.damping, goal=goal
        )

    def test_met(self, problem):
        result = identify(self.with_goal(problem, 1e-5), strategy="swarm", rng=0)
        assert result.success
        assert result.residual <= 1e-5

    def test_missed_is_no_success_and_says_so(self, problem):
        result = identify(self.with_goal(problem, 1e-30), strategy=QUICK, rng=0)
        assert not result.success
        assert [one.numbers["goal"] for one in result.of_kind("goal")] == [1e-30]
        result = identify(self.with_goal(problem, 1e-9), strategy=SWARM_ONLY, rng=0)
        assert not result.success

    def test_a_goal_that_the_swarm_meets_ends_it(self, problem):
        result = identify(self.with_goal(problem, 0.9), strategy=Swarm(max_iterations=100), rng=0)
        assert result.success
        assert result.history.swarm <= 0.9
        assert len(result.history.swarm_curve) < 100

    def test_where_it_is_missed_further_swarms_follow_up_to_so_many(self, problem):
        for restarts in (0, 2):
            swarm = dataclasses.replace(QUICK, restarts=restarts)
            seen = []
            result = identify(self.with_goal(problem, 1e-30), strategy=swarm, rng=0, progress=seen.append)
            assert sum((p.phase, p.iteration) == ("swarm", 1) for p in seen) == 1 + restarts
            assert sum("swarm over" in line for line in result.history.log) == 1 + restarts
            assert result.residual == pytest.approx(min(p.objective for p in seen), rel=1e-2, abs=1e-12)
        met = identify(self.with_goal(problem, 1e-5), strategy=swarm, rng=1)
        assert met.residual <= 1e-5
        assert sum("swarm over" in line for line in met.history.log) == 1

    def test_without_the_local_phase_no_solver_vouches_for_the_result(self, problem):
        for goal in (0.9, None):
            result = identify(dataclasses.replace(problem, goal=goal), strategy=SWARM_ONLY, rng=0)
            assert not result.success
            assert not result.determined


@pytest.mark.usefixtures("ctrl_c")
class TestStopping:
    @staticmethod
    def stop_at(phase, iteration, error):
        seen = []

        def callback(progress):
            seen.append(progress)
            if progress.phase == phase and progress.iteration >= iteration:
                raise error

        return seen, callback

    @pytest.mark.parametrize(("phase", "iteration"), [("swarm", 1), ("swarm", 4), ("local phase", 3)])
    def test_stop_iteration_keeps_the_best_so_far(self, problem, phase, iteration):
        seen, callback = self.stop_at(phase, iteration, StopIteration)
        result = identify(problem, strategy=QUICK, rng=0, callback=callback)
        assert not result.success
        assert not result.interrupted
        assert (seen[-1].phase, seen[-1].iteration) == (phase, iteration)
        assert result.message == "the callback stopped the search"
        if phase == "swarm":
            assert result.residual == pytest.approx(seen[-1].objective, rel=1e-7)
            assert len(result.history.swarm_curve) == iteration
            assert np.isnan(result.history.local)
        else:
            assert result.residual <= result.history.swarm * (1 + 1e-7)

    @pytest.mark.parametrize(("phase", "iteration"), [("swarm", 3), ("local phase", 2)])
    def test_a_keyboard_interrupt_keeps_the_best_so_far(self, problem, phase, iteration):
        seen, callback = self.stop_at(phase, iteration, KeyboardInterrupt)
        result = identify(problem, strategy=QUICK, rng=0, callback=callback)
        assert result.interrupted
        assert not result.success
        assert result.message == "interrupted"
        assert result.findings[0].kind == "stopped" and result.judgement == "no fit"
        assert (seen[-1].phase, seen[-1].iteration) == (phase, iteration)
        assert result.residual <= result.history.swarm * (1 + 1e-7)

    @pytest.mark.parametrize(("phase", "iteration"), [("swarm", 3), ("local phase", 2)])
    def test_ctrl_c_waits_for_the_next_report(self, problem, phase, iteration):
        """Sent while the search runs, it strikes where nothing is lost; afterwards it is the process's own again."""
        seen = []

        def callback(progress):
            seen.append((progress.phase, progress.iteration))
            if seen[-1] == (phase, iteration):
                signal.raise_signal(signal.SIGINT)
                seen.append("went on")

        result = identify(problem, strategy=QUICK, rng=0, callback=callback)
        assert result.interrupted
        assert result.message == "interrupted"
        assert seen[-2:] == [(phase, iteration), "went on"]
        assert result.residual <= result.history.swarm * (1 + 1e-7)
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

    def test_a_second_ctrl_c_waits_too_and_a_third_acts_at_once(self, problem):
        seen = []

        def callback(progress):
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            seen.append("went on")
            signal.raise_signal(signal.SIGINT)
            seen.append("not reached")

        result = identify(problem, strategy=QUICK, rng=0, callback=callback)
        assert result.interrupted
        assert seen == ["went on"]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler

    @pytest.mark.parametrize("phase", ["swarm", "local phase"])
    def test_a_mistake_in_the_callback_is_not_swallowed(self, problem, phase):
        _, callback = self.stop_at(phase, 0, ZeroDivisionError("mine"))
        with pytest.raises(ZeroDivisionError, match="mine"):
            identify(problem, strategy=QUICK, rng=0, callback=callback)

    def test_progress_tells_phases_in_order_with_falling_swarm_residuals(self, problem):
        seen = []
        result = identify(problem, strategy=QUICK, rng=0, progress=seen.append)
        phases = [p.phase for p in seen]
        assert list(dict.fromkeys(phases)) == ["swarm", "local phase"]
        swarm = [p for p in seen if p.phase == "swarm"]
        assert [p.iteration for p in swarm] == list(range(1, 9))
        assert all(p.of == 8 for p in swarm)
        np.testing.assert_array_equal([p.objective for p in swarm], result.history.swarm_curve)
        assert np.all(np.diff([p.objective for p in swarm]) <= 0)
        assert np.all(np.diff([p.seconds for p in seen]) >= 0)
        assert "iteration" in str(seen[0])
        assert "objective" in str(seen[0])


class TestResult:
    @pytest.fixture
    def done(self, problem):
        return identify(problem, strategy=QUICK, rng=2)

    def test_history_tells_each_phase(self, done, problem):
        h = done.history
        assert h.start == h.swarm_curve[0]
        assert h.swarm == h.swarm_curve[-1] <= h.start
        assert h.local == pytest.approx(done.residual, rel=1e-9)
        assert h.local_curve[-1] == pytest.approx(h.local, rel=1e-3, abs=1e-9)
        assert h.refinement_error < 1e-8
        assert h.evaluations >= 8 * 20
        assert sum(count for _, count in h.states) == 7  # the first iteration is the sample, in no state
        assert {name for name, _ in h.states} <= {"exploration", "exploitation", "convergence", "jumping out"}
        assert h.wall_time > 0
        assert any("swarm over" in line for line in h.log)
        assert any("local phase" in line for line in h.log)
        assert any(f"swarm over {problem.n_variables} unknowns" in line for line in h.log)

    def test_residuals_are_those_of_the_measurement(self, done, random_case):
        test = done.measurement
        a = test.predict(done.structure)
        expected = np.linalg.norm(a - test.relative) / np.linalg.norm(test.relative)
        assert done.residual == pytest.approx(expected, rel=1e-12)
        assert done.force_residual is None
        np.testing.assert_array_equal(done.predict(test), a)
        _, forced = random_case(np.random.default_rng(0), "rigid_body", n=3, d=1, force=True)
        result = identify(forced, strategy=SWARM_ONLY, rng=0)
        assert result.force_residual == pytest.approx(forced.measurement.force_residual(result.structure))

    def test_the_history_counts_a_measured_force(self, random_case):
        _, problem = random_case(np.random.default_rng(0), "rigid_body", n=3, d=1, force=True, noise=0.01)
        # Where no noise is stated every record weighs alike.
        unstated = dataclasses.replace(problem.measurement, response_std=None, force_std=None)
        problem = dataclasses.replace(problem, measurement=unstated)
        for strategy in (SWARM_ONLY, QUICK):
            result = identify(problem, strategy=strategy, rng=0)
            both, h = np.hypot(result.residual, result.force_residual), result.history
            assert (h.swarm if strategy is SWARM_ONLY else h.local) == pytest.approx(both, rel=1e-9)
        # Beside an unstated noise the modal fit weighs the force by what free residues leave of it: 1 % here as there.
        assert h.local_curve[-1] == pytest.approx(both, rel=0.3)
        assert h.local_curve[-1] > 1.01 * result.residual

    def test_x_stands_for_the_structure(self, done, problem):
        again = problem.structure(done.x)
        np.testing.assert_array_equal(again.mass, done.structure.mass)
        np.testing.assert_array_equal(again.stiffness, done.structure.stiffness)

    def test_mac_against_the_reference_else_itself(self, case, done):
        truth, problem = case
        a, b = done.structure.mode_shapes, truth.mode_shapes
        expected = (a.T @ b) ** 2 / np.outer(np.sum(a**2, axis=0), np.sum(b**2, axis=0))
        np.testing.assert_allclose(done.mac, expected, rtol=1e-12)
        bare = Problem(problem.measurement, mass=problem.mass, stiffness=problem.stiffness)
        alone = identify(bare, strategy=SWARM_ONLY, rng=0)
        np.testing.assert_allclose(np.diag(alone.mac), 1)

    def test_summary_is_a_table_of_the_modes(self, done):
        text = done.summary()
        assert text.splitlines()[0].startswith("One of many: " if done.success else "No fit: ")
        assert f"search: {done.message}" in " ".join(text.split())
        assert f"seed {done.seed}" in text
        rows = [line for line in text.splitlines() if line[:4].strip().isdigit()]
        frequencies = [float(line.split()[1]) for line in rows]
        np.testing.assert_allclose(frequencies, done.structure.natural_frequencies, rtol=1e-4)
        heads = next(line for line in text.splitlines() if line.startswith("mode"))
        end = heads.index("mass x, %") + len("mass x, %")
        shares = [float(line[:end].split()[-1].lstrip("~")) for line in rows]
        expected = 100 * done.structure.effective_masses[:, 0, 0] / done.structure.rigid_body_mass[0, 0]
        np.testing.assert_allclose(shares, expected, atol=0.06)

    def test_summary_says_what_determines(self, random_case):
        _, problem = random_case(np.random.default_rng(0), "lumped", n=2, d=1)
        result = identify(problem, strategy=QUICK, rng=0)
        assert result.residual < 1e-6
        assert result.determined
        assert "Determined" in result.summary()
        assert all(sentence in result.summary() for sentence in result.closed_by)

    def test_total_mass_unknown_is_said(self, problem):
        bare = Problem(problem.measurement, mass=FullMass(healing="rigid_body"), stiffness=problem.stiffness)
        result = identify(bare, strategy=SWARM_ONLY, rng=0)
        assert result.structure.rigid_body_mass[0, 0] == pytest.approx(1)
        assert not result.determined
        assert any("normalised to 1 kg" in sentence for sentence in result.undetermined)

    @pytest.mark.parametrize("stop", [False, True])
    def test_to_dict_is_strict_json(self, problem, stop):
        _, callback = TestStopping.stop_at("swarm", 2, StopIteration)
        result = identify(problem, strategy=QUICK, rng=2, callback=callback if stop else None)
        figures = result.to_dict()
        again = json.loads(json.dumps(figures, allow_nan=False))
        assert again == figures
        assert again["residual"] == result.residual
        assert again["success"] is (result.success is True)
        np.testing.assert_array_equal(again["natural_frequencies_hz"], result.structure.natural_frequencies)
        np.testing.assert_array_equal(again["total_mass_kg"], np.diag(result.structure.rigid_body_mass))
        assert again["natural_frequencies_hz"] == sorted(again["natural_frequencies_hz"])
        keys = "problem strategy seed success message residual natural_frequencies_hz damping_ratios total_mass_kg"
        assert set(f"{keys} determined evaluations wall_time_s version".split()) <= set(again)
        assert again["version"] == sysid.__version__

    def test_noise_is_fitted_down_to_its_floor_and_not_far_below(self, random_case):
        truth, problem = random_case(np.random.default_rng(1), "rigid_body", n=3, d=1, noise=0.01)
        floor = problem.measurement.residual(truth)
        result = identify(problem, strategy="swarm", rng=0)
        # 80 lines x 3 sensors x 2 parts = 480 numbers; at most 24 are fitted away.
        assert 0.9 * floor < result.residual < 1.001 * floor
