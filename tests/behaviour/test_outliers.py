"""Records with spikes: loss="huber" from the problem to the stored result, against SciPy and against the truth."""

import dataclasses
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import least_squares

import sysid
from sysid.modal_analysis.outliers import TUNING
from sysid.report.report import write_report

FREQ = np.linspace(2.0, 20.0, 150)
W = 2 * np.pi * FREQ
MASSES, SPRINGS, DAMPERS = np.array([5.0, 4.0]), np.array([2e4, 1.5e4]), np.array([9.0, 6.0])
STRETCH = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
ONE_START = sysid.Continuation(starts=1)
pytestmark = pytest.mark.usefixtures("from_one_start_in_module")


def chain(values):
    return STRETCH.T @ np.diag(values) @ STRETCH


TRUTH = sysid.Structure(np.diag([*MASSES, 0.0]), chain(SPRINGS), damping_matrix=chain(DAMPERS)[:2, :2], n_base=1)


def measured(rng, share=0.015, noise=0.01):
    """A noisy test of two floors; some numbers are off by 20 to 100 deviations."""
    test = sysid.simulate(TRUTH, FREQ, noise=noise, rng=rng)
    hit = rng.random(test.response.shape) < share
    off = rng.uniform(20, 100, hit.shape) * test.response_std * np.exp(2j * np.pi * rng.random(hit.shape))
    return dataclasses.replace(test, response=test.response + hit * off)


def two_floors(test, residuals=(), **options):
    """Springs and dampers are unknown."""
    k = sysid.Variable("spring", 2, lower=5e3, upper=8e4)
    c = sysid.Variable("damper", 2, lower=0.5, upper=80.0, log=True)
    K, C = (STRETCH.T @ ca.diag(values) @ STRETCH for values in (k, c))
    mass = np.diag([*MASSES, 0.0])
    further = [sysid.FurtherTest(other, mass=mass, stiffness=K, damping=C[:2, :2]) for other in residuals]
    return sysid.Problem(test, mass=mass, stiffness=K, damping=C[:2, :2], residuals=further, **options)


def by_scipy(*tests):
    """Springs and dampers of least Huber loss, noise as stated."""
    M = np.diag(MASSES)

    def rows(scale):
        K, C = chain(scale[:2] * SPRINGS)[:2, :2], chain(scale[2:] * DAMPERS)[:2, :2]
        w = W[:, None, None]
        made = np.linalg.solve(-(w**2) * M + 1j * w * C + K, w**2 * MASSES[:, None] + 0j)[..., 0].T
        u = np.concatenate([((t.relative[0] - made) / t.response_std[0]).ravel() for t in tests])
        size = np.abs(u)
        # Rows whose squares are the loss.
        u *= np.sqrt(np.where(size > TUNING, 2 * TUNING * size - TUNING**2, size**2)) / size
        return np.concatenate([u.real, u.imag])

    found = least_squares(rows, np.ones(4), xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac").x
    return found * np.concatenate([SPRINGS, DAMPERS])


def test_outliers_are_listed_by_test_run_channel_and_line(tmp_path, no_pictures):
    """Those that were put in, of two tests: in Python, in summary.json and in the report."""
    tests = [sysid.simulate(TRUTH, FREQ, noise=0.01, rng=rng) for rng in (1, 2)]
    put = {(2, 1, "sensor 1", FREQ[100]): 80, (1, 1, "sensor 2", FREQ[20]): 60, (1, 1, "sensor 1", FREQ[90]): 40}
    for number, _, name, freq in put:
        test = tests[number - 1]
        at = 0, int(name[-1]) - 1, int(np.flatnonzero(freq == FREQ)[0])
        test.response[at] += put[number, 1, name, freq] * test.response_std[at]
    result = sysid.identify(two_floors(tests[0], tests[1:], loss="huber"), strategy=ONE_START, rng=0)
    assert [one[:4] for one in result.outliers] == list(put)
    np.testing.assert_allclose([one.size for one in result.outliers], list(put.values()), atol=5)  # of normal noise
    listed = result.to_dict()["outliers"]
    assert [tuple(one.values()) for one in listed] == [tuple(one) for one in result.outliers]
    assert list(listed[0]) == ["test", "run", "channel", "frequency_hz", "deviations"]
    figure = sysid.plot.responses(result, "sensor 2")
    (marked,) = (line for line in figure.axes[0].lines if line.get_label() == "outlier")
    np.testing.assert_array_equal(marked.get_xydata(), [[FREQ[20], np.abs(tests[0].response[0, 1, 20])]])
    assert "outlier" in [text.get_text() for text in figure.legends[0].get_texts()]
    rounds = result.history.phases[-1].evaluations
    curves = {line.get_label()[:6]: line.get_ydata() for line in sysid.plot.convergence(result).axes[0].lines}
    assert curves["rounds"].size == rounds
    assert curves["local "].size == result.history.local_curve.size - rounds
    page = write_report(result, tmp_path).read_text(encoding="utf-8")
    table = page[page.index("farthest from the fit") :]
    assert table.index(f"{FREQ[100]:.6g}") < table.index(f"{FREQ[20]:.6g}") < table.index(f"{FREQ[90]:.6g}")


@pytest.mark.parametrize("strategy", [ONE_START, sysid.Swarm(max_iterations=8, restarts=0)], ids=["start", "swarm"])
def test_the_answer_has_the_least_huber_loss(strategy):
    test = measured(np.random.default_rng(3))
    result = sysid.identify(two_floors(test, loss="huber"), strategy=strategy, rng=0)
    found = np.concatenate([result.values["spring"], result.values["damper"]])
    std = np.concatenate([result.uncertainty.variables[name] for name in ("spring", "damper")])
    np.testing.assert_array_less(np.abs(found - by_scipy(test)) / std, 1e-3)  # where rounds count as settled
    assert result.success and result.determined
    assert np.all(np.abs(found - [*SPRINGS, *DAMPERS]) < 3.5 * std)
    (far,) = result.of_kind("outliers", severity="note")
    assert "count little" in far.sentence and not far.remedy and far.sentence in " ".join(result.summary().split())
    assert any("settled" in one.sentence for one in result.of_kind("search"))
    assert [phase.name for phase in result.history.phases][-1] == "Huber's loss"


def test_two_tests_and_a_known_value_count_by_their_noise(tmp_path, monkeypatch, no_other_answers):
    # No error of a gain among what is not known, which chance adds here: deviations are compared with those of noise.
    shown = lambda modal, structure: SimpleNamespace(possible=np.zeros(modal.records.n_sensors))  # noqa: E731
    monkeypatch.setattr("sysid.assessment.uncertainty.gain_errors", shown)
    rng = np.random.default_rng(5)
    tests = measured(rng), measured(rng, noise=0.03)
    problem = two_floors(tests[0], tests[1:], loss="huber")
    result = sysid.identify(problem, strategy=ONE_START, rng=0)
    std = np.concatenate([result.uncertainty.variables[name] for name in ("spring", "damper")])
    np.testing.assert_array_less(np.abs(result.x - by_scipy(*tests)) / std, 1e-3)
    # Beside a value known ten times better than the records tell it, the answer has that value and its deviation.
    k = problem.formulation.variables[0]
    prior = sysid.Prior(k[0], SPRINGS[0], std[0] / 10)
    known = sysid.identify(
        dataclasses.replace(problem, residuals=[*problem.residuals, prior]), strategy=ONE_START, rng=0
    )
    of_prior = known.uncertainty.variables["spring"][0]
    assert of_prior == pytest.approx(std[0] / np.sqrt(101), rel=0.05)
    off = (result.x[0] + 100 * SPRINGS[0]) / 101 - known.x[0]  # of two independent values by their variances
    assert abs(off) < 0.05 * of_prior
    again = sysid.load(known.save(tmp_path))
    assert again.problem.loss == "huber"
    np.testing.assert_array_equal(again.uncertainty.variables["spring"], known.uncertainty.variables["spring"])
    np.testing.assert_array_equal(again.measurement.response, tests[0].response)
    assert (again.residual, again.summary()) == (known.residual, known.summary())


def test_modes_from_spoiled_records_have_honest_deviations(random_structure):
    """Squares take outliers for modes or lose the masses; with Huber's loss intervals hold what they say."""
    frequencies, ratios = [6.0, 9.0, 12.0], np.array([0.02, 0.03, 0.02])
    truth = random_structure(np.random.default_rng(4), n=3, d=1, frequencies=frequencies, ratios=ratios)
    rng, off = np.random.default_rng(6), []
    for draw in range(3):
        test = sysid.simulate(truth, np.linspace(3, 16, 120), noise=0.01, force=True, rng=rng)
        spikes = {}
        for name in ("response", "force"):
            record, std = getattr(test, name), getattr(test, f"{name}_std")
            hit = rng.random(record.shape) < 0.02
            turn = np.exp(2j * np.pi * rng.random(hit.shape))
            spikes[name] = record + hit * rng.uniform(20, 100, hit.shape) * std * turn
        test = dataclasses.replace(test, **spikes)
        if draw % 2:
            test = dataclasses.replace(test, response_std=None, force_std=None)
        result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass(), loss="huber"), rng=0)
        assert result.success and result.structure.n == 3
        for name in ("natural_frequencies", "damping_ratios"):
            off.append((getattr(result.structure, name) - getattr(truth, name)) / getattr(result.uncertainty, name))
        if draw == 0:
            squares = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
            assert ["loss='huber'" in one.remedy for one in squares.of_kind("outliers")] == [True]
    assert 0.7 < np.sqrt(np.mean(np.square(off))) < 1.3  # 18 numbers, the seed is fixed


def test_clean_records_give_the_answer_of_least_squares_nearly():
    test = sysid.simulate(TRUTH, FREQ, noise=0.01, rng=8)
    squares, huber = (
        sysid.identify(two_floors(test, loss=loss), strategy=ONE_START, rng=0) for loss in ("squares", "huber")
    )
    std, wider = (np.concatenate(list(it.uncertainty.variables.values())) for it in (squares, huber))
    assert np.all(np.abs(huber.x - squares.x) < 0.8 * std)
    np.testing.assert_allclose(wider / std, 1 / np.sqrt(0.95), rtol=0.06)  # by its efficiency
    assert not squares.of_kind("outliers") and not huber.of_kind("outliers")


def test_a_wrong_model_is_doubted_as_it_is_by_squares():
    """Spikes or not, springs and dampers cannot make up for a mass that is a third off."""
    wrong = np.diag([1.3 * MASSES[0], MASSES[1], 0.0])
    problem = dataclasses.replace(two_floors(measured(np.random.default_rng(2)), loss="huber"), mass=wrong)
    result = sysid.identify(problem, strategy=ONE_START, rng=0)
    assert not result.determined
    assert result.of_kind("misfit", "beyond noise", severity="contradicts")


@pytest.mark.parametrize(("raised", "told"), [(StopIteration, "stopped the search"), (ZeroDivisionError, None)])
def test_a_callback_stops_a_round_of_the_loss_and_its_mistakes_are_not_swallowed(raised, told):
    at = []

    def in_a_round(progress):
        again = bool(at) and progress.phase == at[-1][0] == "local phase" and progress.iteration <= at[-1][1]
        at.append((progress.phase, progress.iteration))
        if again:
            raise raised

    problem = two_floors(measured(np.random.default_rng(3)), loss="huber")
    if told is None:
        with pytest.raises(raised):
            sysid.identify(problem, strategy=ONE_START, rng=0, callback=in_a_round)
    else:
        result = sysid.identify(problem, strategy=ONE_START, rng=0, callback=in_a_round)
        assert told in result.message and not result.success and not result.interrupted
        assert result.of_kind("outliers")


def test_what_cannot_be_is_refused():
    test = measured(np.random.default_rng(0))
    with pytest.raises(sysid.InputError, match="loss = 'l1' is unknown; give one of 'squares', 'huber'"):
        two_floors(test, loss="l1")
    with pytest.raises(sysid.InputError, match="loss='huber' is of records"):
        two_floors(test, loss="huber", misfit=sysid.Variable("a", lower=0, upper=1) - 0.5)
    with pytest.raises(sysid.InputError, match=r"Swarm\(local=None\) has none"):
        sysid.identify(two_floors(test, loss="huber"), strategy=sysid.Swarm(local=None), rng=0)
    from sysid.compare.comparison import compare

    with pytest.raises(sysid.InputError, match="compare minimises squares"):
        compare(two_floors(test, loss="huber"))
