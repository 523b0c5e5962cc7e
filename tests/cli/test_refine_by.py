"""``sysid run --refine-by``: which strategies take it, what is refused, and what is told of leaders."""

import json
import re

import pytest

import sysid
from sysid.cli import main as cli

RUN = ["run", "pair.py", "--out", "out", "--strategy", "hpso-ls"]
FREE = """
import numpy as np
import sysid


def problem(*, data=None, rng=0):
    K = 1e4 * np.array([[2.0, -1.0], [-1.0, 1.0]])
    G = np.ones((2, 1))
    truth = sysid.Structure(
        np.diag([2.0, 1.0, 0.5]), np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]]), [0.01, 0.02], n_base=1
    )
    test = sysid.simulate(truth, np.linspace(3.0, 30.0, 80), noise=0.01, force=True, rng=rng)
    return sysid.Problem(test, mass=sysid.FullMass())
"""


@pytest.fixture
def asked(here, monkeypatch, no_pictures):
    """The strategies of searches that the command line asks for; each a short one."""
    strategies, original = [], sysid.identify

    def identify(problem, *, strategy, **options):
        strategies.append(strategy)
        return original(problem, strategy=sysid.Swarm(3, 8, refine_by=strategy.refine_by, restarts=0), **options)

    (here / "pair.py").write_text(FREE)
    monkeypatch.setattr(cli, "identify", identify)
    return strategies


@pytest.mark.parametrize("way", ["closed-form", "ipopt", "leaders"])
def test_the_way_is_that_of_the_strategy(asked, way):
    assert cli.main([*RUN, "--refine-by", way]) in (0, 1)
    assert asked == [sysid.Swarm.published(refine_by=way)]


def test_leaders_are_told_on_every_way_out(asked, here, capsys):
    cli.main([*RUN, "--refine-by", "leaders"])
    history = sysid.load(here / "out").history
    assert history.leaders_tried >= 1
    words = f"IPOPT refined {history.leaders_tried} leader"
    assert words in capsys.readouterr().out
    figures = json.loads((here / "out" / "summary.json").read_text())
    told = {name: figures[name] for name in ("leaders_tried", "leaders_won", "refinement_statuses")}
    assert told == {
        "leaders_tried": history.leaders_tried, "leaders_won": history.leaders_won,
        "refinement_statuses": dict(history.refinement_statuses),
    }  # fmt: skip


@pytest.mark.parametrize("strategy", ["auto", "modal", "continuation"])
def test_other_strategies_refuse_it(here, complaint, files, strategy):
    assert cli.main(["run", "pair.py", "--out", "out", "--strategy", strategy, "--refine-by", "leaders"]) == 2
    error = complaint()
    assert error.startswith("sysid: --refine-by ")
    assert re.findall(r"'([\w-]+)'", error) == ["swarm", "hpso-ls", strategy]  # those that take it, and this one
    assert not (here / "out").exists()


def test_a_problem_without_a_spectrum_of_its_own_refuses_it(here, complaint):
    assert cli.main(["run", "shear_building", "--out", "out", "--strategy", "swarm", "--refine-by", "ipopt"]) == 2
    error = complaint()
    assert error.startswith("sysid: --refine-by ipopt: ") and "stiffness" in error


def test_a_word_that_is_no_way_is_refused(here, complaint):
    assert cli.main([*RUN, "--refine-by", "closed form"]) == 2
    assert "'closed-form', 'ipopt', 'leaders'" in complaint()


def test_a_run_that_goes_on_keeps_its_way(here, monkeypatch, no_pictures, capsys):
    """Also without its options said again; another way is another run."""
    (here / "pair.py").write_text(FREE)
    original, strategies = sysid.identify, []

    def identify(*arguments, strategy, **options):
        strategies.append(strategy)

        def interrupt(progress):
            if len(strategies) == 1 and (progress.phase, progress.iteration) == ("swarm", 3):
                raise KeyboardInterrupt

        return original(*arguments, strategy=strategy, callback=interrupt, **options)

    monkeypatch.setattr(cli, "identify", identify)
    asked = [*RUN, "--refine-by", "leaders"]
    assert cli.main(asked) == 130
    assert cli.main([*RUN[:2], "--resume", "out", "--strategy", "hpso-ls", "--refine-by", "ipopt"]) == 2
    assert re.findall(r"refined by (\w+)", capsys.readouterr().err) == ["leaders", "ipopt"]
    assert cli.main([*RUN[:2], "--resume", "out"]) in (0, 1)
    assert strategies == [sysid.Swarm.published(refine_by="leaders")] * 2
