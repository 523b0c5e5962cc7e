"""The simulators of laboratory records: closed form, recursion and an integrator from elsewhere agree."""

import importlib
from pathlib import Path

import numpy as np
import pytest
import scipy.integrate

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def simulated():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))
        return importlib.import_module("benchmarks.records.simulated")


def _case(simulated, duration, seed=3):
    """Coupled structure, base in two or three directions, base motion and free vibration."""
    setting = next(s for s in map(simulated.coupled, range(50)) if s.structure.n_base >= 2)
    rng = np.random.default_rng(seed)
    modes = simulated.Modes.of(setting.structure)
    motion = simulated.random_motion(
        rng, duration(setting), setting.sample_rate, setting.motion, correlation=setting.correlation, power=-2.0
    )
    return setting, simulated.Run.ringing(modes, motion, rng)


def _distance(a, b):
    return np.linalg.norm(a - b) / np.linalg.norm(b)


def test_closed_form_and_recursion_agree_as_far_as_the_hold_does(simulated):
    """First-order hold turns a cosine's amplitude down by sinc², so it errs by a quarter at twice the rate."""
    _, run = _case(simulated, lambda s: 30 / s.structure.natural_frequencies[0])
    exact = run.records()
    error = {}
    for factor in (25, 50):
        other = run.records_by_recursion(factor)
        np.testing.assert_allclose(other.base, exact.base, atol=1e-12)
        error[factor] = max(_distance(other.response, exact.response), _distance(other.force, exact.force))
    assert error[50] < 2e-4
    assert error[25] / error[50] == pytest.approx(4, rel=0.05)


def test_closed_form_solves_the_equations_of_motion_of_the_matrices(simulated):
    """Against a Runge-Kutta integration of M v'' + C v' + K v = -B u'', and the force of the base on all masses."""
    setting, run = _case(simulated, lambda s: 3 / s.structure.natural_frequencies[0])
    s, motion, exact = setting.structure, run.motion, run.records()
    n, G = s.n, s.rigid_body_dofs
    M, K = s.mass[:n, :n], s.stiffness[:n, :n]
    q, velocity = run.state(0.0)

    def base(t):
        return (motion.amplitudes @ np.exp(1j * motion.omega * t)).real

    def acceleration(t, v, rate):
        return np.linalg.solve(M, -s.damping @ rate - K @ v - (M @ G + s.mass[:n, n:]) @ base(t))

    shapes = run.modes.shapes  # the sensors are the degrees of freedom
    time = np.arange(motion.samples) / motion.sample_rate
    solved = scipy.integrate.solve_ivp(
        lambda t, y: np.concatenate([y[n:], acceleration(t, y[:n], y[n:])]), time[[0, -1]],
        np.concatenate([shapes @ q, shapes @ velocity]), method="DOP853", t_eval=time, rtol=1e-9, atol=1e-12,
    )  # fmt: skip
    relative = np.array([acceleration(t, y[:n], y[n:]) for t, y in zip(time, solved.y.T, strict=True)]).T
    u = np.array([base(t) for t in time]).T
    absolute = relative + G @ u
    np.testing.assert_allclose(exact.base, u, atol=1e-11)
    assert _distance(exact.response, absolute) < 1e-7
    force = G.T @ (M @ absolute + s.mass[:n, n:] @ u) + s.mass[n:, :n] @ absolute + s.mass[n:, n:] @ u
    assert _distance(exact.force, force) < 1e-7


def test_records_are_cut_in_motion_with_noise_of_the_stated_size(simulated):
    """Of four storeys: the frequencies, the rms of the base and the noise of each channel are as stated."""
    setting = simulated.four_storeys()
    frequencies = setting.structure.natural_frequencies
    assert frequencies[[0, -1]] == pytest.approx([2.7, 12.8], abs=0.1)
    rng = np.random.default_rng(1)
    clean = setting.run(rng).records()
    noisy, levels = setting.with_noise(clean, rng)
    assert clean.base.shape == (1, 24_000)
    assert np.sqrt(np.mean(clean.base**2)) == pytest.approx(1, rel=0.05)
    for name in ("base", "response", "force"):
        record, level = getattr(clean, name), getattr(levels, name)
        np.testing.assert_allclose(level, 0.01 * np.sqrt(np.mean(record**2, axis=1)))
        np.testing.assert_allclose(np.std(getattr(noisy, name) - record, axis=1), level, rtol=0.03)
    ends = np.abs(clean.response[:, [0, -1]]) / np.std(clean.response, axis=1, keepdims=True)
    assert np.all(ends.max(axis=0) > 0.1)
