"""Complex residuals of the user's own: gain, delay and loss factor as unknowns, with the noise of the records."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import sysid
from sysid.models.complex_expressions import ComplexExpression

FREQ = np.linspace(1.0, 12.0, 150)
W = 2 * np.pi * FREQ[None]
MASSES, SPRINGS, ETA, GAIN, DELAY = (3.0, 2.0), (4000.0, 2500.0), 0.06, 1.04, 0.0021


def answer(k, eta, gain, delay, number=1.0):
    """Absolute accelerations of two masses in a row for unit base motion, springs of one loss factor; (2, lines).

    The second sensor reads so much more, and both are late. Written once: of numbers, and of variables.
    """
    lower, upper = ((number + 1j * eta) * one for one in (k[0], k[1]))
    direct, corner = lower + upper - MASSES[0] * W**2, upper - MASSES[1] * W**2
    over = direct * corner - upper * upper
    late = np.exp(-1j * W * delay) / over
    first, second = late * (corner * lower), late * (upper * lower) * gain
    return first, second


def records(noise=0.0, seed=0, delay=DELAY):
    """The test, its noise stated, larger in the second sensor."""
    clean = np.vstack(answer(SPRINGS, ETA, GAIN, delay))
    rng, std = np.random.default_rng(seed), noise * np.array([[1.0], [3.0]])
    drawn = rng.standard_normal((2, *clean.shape)) / np.sqrt(2)
    noisy = clean + std * (drawn[0] + 1j * drawn[1])
    return sysid.Measurement.from_frf(
        FREQ, noisy, rigid_body=np.ones((2, 1)), response_std=std[:, None] if noise else None
    )


def unknowns():
    return (
        sysid.Variable("springs", 2, lower=1e3, upper=1e4, guess=[3600.0, 2800.0], unit="N/m"),
        sysid.Variable("loss", lower=0.0, upper=0.5, guess=0.04),
        sysid.Variable("gain", lower=0.5, upper=2.0, guess=1.0),
        sysid.Variable("delay", lower=-0.02, upper=0.02, guess=0.0, unit="s"),
    )


def stacked(k, eta, gain, delay):
    first, second = answer(k, eta, gain, delay)
    return ComplexExpression(*map(ca.vertcat, first, second))


def problem(test, beside=False, **given):
    k, eta, gain, delay = unknowns()
    stretch = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
    misfit = sysid.real_and_imaginary(stacked(k, eta, gain, delay) - test.response[0])
    return sysid.Problem(
        test, mass=np.diag([*MASSES, 0.0]), stiffness=stretch.T @ ca.diag(k) @ stretch, damping=[eta / 2, eta / 2],
        **({"residuals": [misfit]} if beside else {"misfit": misfit, **given}),
    )  # fmt: skip


TRUE = {"springs": SPRINGS, "loss": ETA, "gain": GAIN, "delay": DELAY}


def test_loss_factor_gain_and_delay_are_recovered_within_their_deviations(from_one_start):
    off = []
    for seed in range(8):
        with from_one_start():
            result = sysid.identify(problem(records(0.05, seed)), rng=0)
        std = result.uncertainty.variables
        off += [(np.ravel(result.values[name]) - TRUE[name]) / np.ravel(std[name]) for name in TRUE]
    off = np.concatenate(off)
    assert np.abs(off).max() < 4.0
    assert 0.7 < np.sqrt(np.mean(off**2)) < 1.35  # 40 numbers: one with a deviation of 0.11


def test_exact_records_give_exact_values():
    result = sysid.identify(problem(records()), rng=0)
    for name, value in TRUE.items():
        np.testing.assert_allclose(result.values[name], value, rtol=1e-6)


def test_rows_and_their_slopes_are_those_of_complex_numbers():
    """Relative to the record, channel by channel by its noise; slopes by central differences."""
    test = records(0.05)
    made = problem(test).formulation
    (term,), order = made.terms, [unknown.name for unknown in made.unknowns]
    at = {"springs": np.array(SPRINGS), "loss": 0.05, "gain": 1.02, "delay": 0.0013}
    weight = 1 / test.response_std[0]
    size = np.linalg.norm(weight * test.relative[0])

    def rows(x):
        values = dict(zip(order, np.split(x, np.cumsum([made.unknowns[i].size for i in range(4)])[:-1]), strict=True))
        z = np.vstack(answer(*(values[name] if name == "springs" else values[name][0] for name in at)))
        z = weight * (z - test.response[0]) / size
        return np.vstack([z.real, z.imag]).ravel(order="F")

    x = np.concatenate([np.ravel(at[name]) for name in order])
    found = term.linearised(x, 1.0)
    np.testing.assert_allclose(found.residuals, rows(x), atol=1e-12)
    for i, step in enumerate(1e-6 * np.abs(x)):
        moved = step * (np.arange(x.size) == i)
        wanted = (rows(x + moved) - rows(x - moved)) / (2 * step)
        np.testing.assert_allclose(found.jacobian[:, i], wanted, atol=2e-8 * np.abs(wanted).max())


def test_beside_the_records_each_number_counts_as_they_do():
    """The residual of the model that the test is fitted by: the sum of squares is twice that of the test alone."""
    stretch = np.array([[1.0, 0.0, -1.0], [-1.0, 1.0, 0.0]])
    true_K = stretch.T @ np.diag(SPRINGS) @ stretch
    truth = sysid.Structure(np.diag([*MASSES, 0.0]), true_K, damping_matrix=0.002 * true_K[:2, :2], n_base=1)
    clean = sysid.simulate(truth, FREQ, noise=0.02, rng=0)
    test = replace(clean, response_std=clean.response_std * [[1.0], [3.0]])  # as if the second sensor were noisier
    k, c = sysid.Variable("k", 2, lower=1e3, upper=1e4), sysid.Variable("c", lower=1.0, upper=50.0)
    K = stretch.T @ ca.diag(k) @ stretch
    C = c * np.eye(2)
    response = sysid.FurtherTest(test, mass=np.diag([*MASSES, 0.0]), stiffness=K, damping=C).response
    term = sysid.real_and_imaginary(response - test.response[0])
    given = {"mass": np.diag([*MASSES, 0.0]), "stiffness": K, "damping": C}
    alone, both = (sysid.Problem(test, **given, residuals=more) for more in ([], [term]))
    x = np.array([3900.0, 2600.0, 9.0])
    one, two = (each.formulation.objective(x) for each in (alone, both))
    assert two**2 == pytest.approx(2 * one**2, rel=1e-9)


@pytest.mark.parametrize("misfit", [True, False])
def test_a_result_keeps_its_complex_residual(tmp_path, from_one_start, misfit):
    with from_one_start():
        result = sysid.identify(problem(records(0.05, delay=0.0), beside=not misfit), rng=0)
    again = sysid.load(result.save(tmp_path / "result.h5"))
    assert again.objective == pytest.approx(result.objective, rel=1e-12)
    np.testing.assert_allclose(again.uncertainty.variables["gain"], result.uncertainty.variables["gain"], rtol=1e-9)


def test_arithmetic_is_that_of_complex_numbers():
    x = sysid.Variable("x", (2, 3), lower=-1.0, upper=1.0)
    at = np.random.default_rng(0).uniform(0.5, 1.0, (2, 3))
    z = np.random.default_rng(1).standard_normal((2, 3)) + 1j
    written = [
        (x + z, at + z), (z + x, at + z), (x - z, at - z), (z - x, z - at), (x * z, at * z), (z / x, z / at),
        (x / z, at / z), ((1 + 2j) * x, (1 + 2j) * at), (x * 1j, at * 1j), (z.T @ x, z.T @ at), (x @ z.T, at @ z.T),
        (2 / (1j + x), 2 / (1j + at)), (-(x * 1j), -1j * at), (np.conj(1j * x), -1j * at),
        (np.exp(1j * x), np.exp(1j * at)),
        (x * z[:1], at * z[:1]), ((1j * x) * z[:, :1], 1j * at * z[:, :1]), (z * (x * 1j), z * at * 1j),
        (np.float64(2) * (x * 1j), 2j * at), ((x + z) - x, z), (x - (x + z), -z), (x / (x + z), at / (at + z)),
    ]  # fmt: skip
    for expression, value in written:
        real, imag = ca.Function("f", [x.symbol], list(expression))(at)
        np.testing.assert_allclose(np.asarray(real) + 1j * np.asarray(imag), value, rtol=1e-13, atol=1e-14)


def test_what_is_real_or_of_another_shape_is_refused():
    test, (k, *_) = records(), unknowns()
    with pytest.raises(sysid.InputError, match="real"):
        sysid.real_and_imaginary(k - 1.0)
    with pytest.raises(sysid.InputError, match="do not fit"):
        (1j * k) * test.response[0, :1, :3].T
    with pytest.raises(sysid.InputError, match="no product"):
        (1j * k) @ test.response[0]
    with pytest.raises(sysid.InputError, match="takes no complex"):
        np.sin(1j * k)
    one = sysid.Variable("one", lower=1.0, upper=2.0)
    model = {"mass": np.diag(MASSES), "stiffness": one * 1e3 * np.array([[2, -1], [-1, 1]]), "damping": np.eye(2)}
    for force in (False, True):
        wrong = sysid.real_and_imaginary(1j * one, force=force)
        with pytest.raises(sysid.InputError, match="misfit"):
            sysid.identify(sysid.Problem(test, **model, misfit=wrong), rng=0)


def test_a_force_has_its_own_noise():
    clean = sysid.simulate(sysid.Structure(np.diag([2.0, 1.0]), 800 * np.array([[1, -1], [-1, 1]]), [0.02], n_base=1),
                           np.linspace(1, 6, 60), force=True, noise=0.01, rng=0)  # fmt: skip
    k, scale = sysid.Variable("k", lower=500.0, upper=1500.0), sysid.Variable("force gain", lower=0.5, upper=1.5)
    test = replace(clean, force=1.1 * clean.force)
    model = {"mass": np.diag([2.0, 1.0]), "stiffness": k, "damping": [[1.6]]}
    further = sysid.FurtherTest(test, **model)
    given = [sysid.real_and_imaginary(scale * further.force - test.force[0], force=True)]
    only = replace(test, force=None, force_std=None)
    with pytest.raises(sysid.InputError, match="base force"):
        sysid.identify(sysid.Problem(only, **model, residuals=given), rng=0)
    result = sysid.identify(sysid.Problem(test, **model, misfit=given[0]), rng=0)
    assert result.values["force gain"] == pytest.approx(1.1, abs=4 * result.uncertainty.variables["force gain"])
