"""identify with strategy "auto": which strategy is taken, which follows, and what is said of it."""

import numpy as np
import pytest

import sysid
from sysid import InputError, Problem, SolverError, Swarm, identify
from sysid.search.strategy import DoesNotApplyError

QUICK = Swarm(max_iterations=8, n_particles=20)


@pytest.fixture
def case(random_case):
    return random_case(np.random.default_rng(0), "rigid_body", n=3, d=1)


@pytest.fixture
def problem(case):
    return case[1]


def strategy_of(result):
    """Why it was taken."""
    (told,) = result.of_kind("strategy")
    return told.sentence


class TestAuto:
    """Which strategy is taken, and that the result says why."""

    @staticmethod
    def at_once(problem, **options):
        """Stopped with the first news: what is taken shows by then."""

        def stop(progress):
            raise StopIteration

        return identify(problem, rng=0, callback=stop, **options)

    @pytest.mark.parametrize("mass", ["trace", "rigid_body", "lumped", "known"])
    def test_modal_for_full_lumped_and_known_mass(self, random_case, mass):
        _, problem = random_case(np.random.default_rng(1), mass, n=3, d=1)
        result = identify(problem, rng=0)
        assert result.strategy == "modal"
        assert strategy_of(result).startswith("strategy 'modal': ")
        assert any(strategy_of(result) in line for line in result.summary().splitlines())
        assert result.residual < 1e-10

    @pytest.mark.parametrize(
        ("stiffness", "damping", "strategy", "reason"),
        [
            ("chain", "modal", "continuation", "stiffness has a form of its own"),
            ("spectral", "proportional", "swarm", "damping has a form of its own"),
        ],
    )
    def test_another_where_a_model_has_a_form_of_its_own(self, random_case, stiffness, damping, strategy, reason):
        _, problem = random_case(np.random.default_rng(1), "lumped", stiffness, damping, n=3, d=1)
        result = self.at_once(problem)
        assert result.strategy == strategy
        assert strategy_of(result) == f"strategy '{strategy}': the {reason}"
        with pytest.raises(InputError, match="'modal' needs a free stiffness .SpectralStiffness. and ModalDamping"):
            identify(problem, strategy="modal")

    def test_swarm_with_a_start(self, case):
        truth, problem = case
        result = self.at_once(problem, start=truth)
        assert result.strategy == "swarm"
        assert strategy_of(result) == "strategy 'swarm': a start was given"

    @pytest.mark.parametrize("mass", ["lumped", "known"])
    def test_swarm_where_a_structured_mass_has_other_than_one_mode_a_sensor(self, random_case, mass):
        """Lines that end above the first mode: the model is said to have four, the data hide the others in noise."""
        truth, problem = random_case(np.random.default_rng(1), mass, n=4, d=2, noise=0.05)
        f, test = truth.natural_frequencies, problem.measurement
        low = Problem(
            test.in_band(0.0, np.sqrt(f[0] * f[1])), mass=problem.mass,
            stiffness=sysid.SpectralStiffness(f[:1], max_frequency=1.1 * f[-1]),
        )  # fmt: skip
        result = self.at_once(low)
        assert result.strategy == "swarm"
        assert any(strategy_of(result) in line for line in result.history.log)
        with pytest.raises(InputError, match="as many modes as sensors") as refused:
            identify(low, strategy="modal")
        assert strategy_of(result).endswith(f"the modal one does not apply ({refused.value})")

    def test_swarm_where_a_stated_frequency_is_none_of_the_datas(self, random_case):
        truth, problem = random_case(np.random.default_rng(1), "rigid_body", n=3, d=1)
        given = truth.natural_frequencies * [1.0, 1.0, 1.4]
        wrong = Problem(problem.measurement, mass=problem.mass, stiffness=sysid.SpectralStiffness(given))
        result = self.at_once(wrong)
        assert result.strategy == "swarm"
        with pytest.raises(InputError, match=f"{given[2]:.5g} Hz") as refused:
            identify(wrong, strategy="modal")
        assert strategy_of(result).endswith(f"the modal one does not apply ({refused.value})")

    def test_where_none_applies_one_error_tells_of_each(self, problem, monkeypatch):
        def run(strategy, *_):
            raise DoesNotApplyError(f"{strategy.name} is refused")

        for kind in (sysid.Modal, sysid.Continuation, Swarm):
            monkeypatch.setattr(kind, "run", run)
        with pytest.raises(InputError, match="modal is refused; nor does the swarm: swarm is refused") as caught:
            identify(problem, rng=0)
        assert not isinstance(caught.value, DoesNotApplyError)

    def test_a_search_that_fails_after_one_that_does_not_apply_tells_why_it_was_tried(self, problem, monkeypatch):
        def run(strategy, *_):
            raise (SolverError if isinstance(strategy, Swarm) else DoesNotApplyError)(f"{strategy.name} is refused")

        for kind in (sysid.Modal, sysid.Continuation, Swarm):
            monkeypatch.setattr(kind, "run", run)
        with pytest.raises(SolverError, match="modal is refused; nor does the swarm: swarm is refused"):
            identify(problem, rng=0)

    @pytest.mark.parametrize("asked", ["modal", "swarm", sysid.Modal(), QUICK])
    def test_what_was_asked_is_said_to_be_so(self, problem, asked):
        result = self.at_once(problem, strategy=asked)
        name = asked if isinstance(asked, str) else type(asked).__name__.lower()
        assert result.strategy == name
        assert strategy_of(result) == f"strategy {name!r}, as asked"
