"""Responses in time: against Runge-Kutta integration of the matrices, scipy.signal.lsim and steady cosines."""

import numpy as np
import pytest
import scipy.integrate
import scipy.signal

import sysid

N, D = 3, 2


def _structure(damping):
    rng = np.random.default_rng(4)
    A = rng.standard_normal((N + D, N + D))
    M = A @ A.T + 2 * np.eye(N + D)
    A = rng.standard_normal((N, N))
    K_SS = 4e3 * (A @ A.T + 0.5 * np.eye(N))
    G = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.5]])
    K = np.block([[K_SS, -K_SS @ G], [-G.T @ K_SS, G.T @ K_SS @ G]])
    recovery = rng.standard_normal((4, N))
    A = rng.standard_normal((N, N))
    how = {
        "light": {"damping_ratios": [0.01, 0.02, 0.0]},
        "overdamped": {"damping_ratios": [1.0, 0.3, 1.7]},
        "coupled": {"damping_matrix": 3 * (A @ A.T)},
    }[damping]
    return sysid.Structure(M, (K + K.T) / 2, n_base=D, recovery=recovery, **how)


@pytest.mark.parametrize("damping", ["light", "overdamped", "coupled"])
def test_a_cubic_base_acceleration_is_answered_exactly(damping):
    """Against the integration of M_SS v'' + C v' + K_SS v = -B u'' from a given state, by SciPy's DOP853."""
    s = _structure(damping)
    rng = np.random.default_rng(0)
    powers, initial = rng.standard_normal((D, 4)), 0.1 * rng.standard_normal((2, N))
    rate, time = 20.0, np.arange(41) / 20.0
    M, K, B = s.mass[:N, :N], s.stiffness[:N, :N], s.mass[:N, :N] @ s.rigid_body_dofs + s.mass[:N, N:]
    base = lambda t: np.array([np.polyval(p, t) for p in powers])  # noqa: E731

    def acceleration(t, y):
        return np.linalg.solve(M, -s.damping @ y[N:] - K @ y[:N] - B @ base(t))

    solved = scipy.integrate.solve_ivp(
        lambda t, y: np.concatenate([y[N:], acceleration(t, y)]), time[[0, -1]], (initial @ s.normal_modes.T).ravel(),
        method="DOP853", t_eval=time, rtol=1e-11, atol=1e-12,
    )  # fmt: skip
    u = base(time)
    relative = np.array([acceleration(t, y) for t, y in zip(time, solved.y.T, strict=True)]).T
    expected = s.recovery @ (relative + s.rigid_body_dofs @ u)
    size = np.abs(expected).max()
    np.testing.assert_allclose(s.simulate(u, rate, initial=initial), expected, atol=1e-8 * size)
    force = B.T @ relative + s.rigid_body_mass @ u
    np.testing.assert_allclose(
        s.simulate_force(u, rate, initial=initial), force, atol=1e-8 * np.abs(force).max()
    )  # fmt: skip


def test_from_rest_it_is_the_state_space_model_in_time():
    """Against scipy.signal.lsim, whose straight lines between samples are fine enough at 500 samples a period."""
    s = _structure("coupled")
    rate = 500 * s.natural_frequencies[-1]
    time = np.arange(2000) / rate
    u = np.array([np.sin(5 * time) ** 3, np.cos(9 * time) - 1])
    expected = scipy.signal.lsim(s.to_state_space(), u.T, time)[1].T
    np.testing.assert_allclose(s.simulate(u, rate), expected, atol=2e-5 * np.abs(expected).max())


@pytest.mark.parametrize("samples", [2.5, 3, 4])
def test_a_steady_cosine_loses_what_the_docstring_says(samples):
    """Steady state by transmissibility and apparent mass, at the lines that the spline adds too (its images)."""
    s = _structure("overdamped")
    f = 0.7 * s.natural_frequencies[1]
    rate, count = samples * f, int(400 * samples)
    u = np.array([1.0, -0.5])[:, None] * np.exp(2j * np.pi * np.arange(count) / samples)
    k = np.arange(-50, 51)
    shares = np.sinc(1 / samples - k) ** 12 / np.sum(np.sinc(1 / samples - k) ** 12)
    lines, shares = f - rate * k[48:53], shares[48:53]
    middle = slice(count // 2, -count // 8)  # free vibration has died down, the end of the spline is far
    for simulated, frf, inertia in (
        (s.simulate(u.real, rate), s.transmissibility, s.rigid_body - s.mode_shapes @ s.participation),
        (s.simulate_force(u.real, rate), s.base_force, s.rigid_body_mass - s.effective_masses.sum(axis=0)),
    ):
        every = np.where(lines > 0, frf(np.abs(lines)), frf(np.abs(lines)).conj())
        # What springs and dampers answer is that of all these lines, what follows the base at once is exact.
        exact, expected = every[..., 2] @ u, ((every - inertia[..., None]) @ shares + inertia) @ u
        lost = np.abs(simulated - exact.real)[:, middle].max()
        assert np.abs(simulated - expected.real)[:, middle].max() < max(1e-3 * lost, 1e-11)
        assert lost < 4 * (1 - shares[2]) * np.abs(exact).max()
    assert 1 - shares[2] == pytest.approx({2.5: 7.6e-3, 3: 2.4e-4, 4: 1.9e-6}[samples], rel=0.03)


def test_records_of_a_few_samples_are_answered():
    """Up to the degree that so few samples allow: straight lines through two, for which lsim is exact."""
    s = _structure("light")
    u, time = np.array([[1.0, -2.0], [0.5, 1.5]]), np.array([0.0, 0.05])
    expected = scipy.signal.lsim(s.to_state_space(), u.T, time)[1].T
    np.testing.assert_allclose(s.simulate(u, 20.0), expected, atol=1e-10)


def test_the_first_state_is_found_from_records():
    """Without noise exactly; with noise within four of the deviations that least squares gives it."""
    s = _structure("coupled")
    rng = np.random.default_rng(1)
    rate = 20 * s.natural_frequencies[-1]
    u, initial = rng.standard_normal((D, 3000)), 0.1 * rng.standard_normal((2, N))
    response = s.simulate(u, rate, initial=initial)
    np.testing.assert_allclose(s.initial_state(u, response, rate), initial, rtol=1e-8, atol=1e-10)

    quiet = np.zeros_like(u)
    columns = np.array(
        [s.simulate(quiet, rate, initial=unit.reshape(2, N)).ravel() for unit in np.eye(2 * N)]
    ).T  # fmt: skip
    level = 0.05 * np.std(response)
    std = level * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))
    found = s.initial_state(u, response + level * rng.standard_normal(response.shape), rate)
    distance = np.abs(found - initial).ravel() / std
    assert np.all(distance < 4) and np.any(distance > 0.1)


def test_a_mode_that_no_sensor_sees_starts_at_rest():
    s = _structure("light")
    unseen = sysid.Structure(
        s.mass, s.stiffness, s.damping_ratios, n_base=D, recovery=(s.normal_modes[:, :1] @ [[1.0]]).T @ s.mass[:N, :N]
    )
    initial = np.array([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]])
    u = np.zeros((D, 500))
    found = unseen.initial_state(u, unseen.simulate(u, 50.0, initial=initial), 50.0)
    np.testing.assert_allclose(found, initial * [1, 0, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("base", "options", "said"),
    [
        (np.zeros((3, 10)), {}, r"base has shape \(3, 10\); it must be \(2, n_samples\)"),
        (np.zeros((2, 1)), {}, "base has 1 samples; at least two"),
        (np.full((2, 9), np.nan), {}, "base"),
        (np.zeros((2, 10)), {"sample_rate": 0.0}, "sample_rate = 0 Hz"),
        (np.zeros((2, 10)), {"initial": np.zeros(6)}, r"initial has shape \(6,\); it must be \(2, 3\)"),
    ],
)
def test_mistakes_are_named(base, options, said):
    with pytest.raises(sysid.InputError, match=said):
        _structure("light").simulate(base, **{"sample_rate": 10.0, **options})


def test_records_of_unequal_length_are_refused():
    with pytest.raises(sysid.InputError, match=r"response has shape \(4, 9\); it must be \(4, 10\)"):
        _structure("light").initial_state(np.zeros((2, 10)), np.zeros((4, 9)), 10.0)
