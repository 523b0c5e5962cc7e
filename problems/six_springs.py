"""Six-storey shear chain, six springs and six dampers unknown, masses known (simulated; Chen, Chen, Liu 2014).

Springs and dampers are those that Chen, Chen and Liu (2014) identify with an ant colony, from responses alone. Their
masses are not at hand: 100,000 kg each is taken here. The input is chosen here too: the base is shaken with the same
displacement amplitude, 0.01 m, at the lines k/T from 0.03 to 0.6 Hz, T = 2400 s, so that its acceleration rises with
the square of the frequency and no mode drowns the others in the noise. Noise is relative to the root mean square of
all absolute accelerations, as in `sysid.simulate`.
"""

import casadi as ca
import numpy as np

import sysid

SPRINGS = np.array([271390.0, 290360.0, 282690.0, 252480.0, 233540.0, 229940.0])  # N/m, from the base up
DAMPERS = np.array([2469.65, 2874.56, 2572.48, 2297.57, 2265.33, 2092.45])  # N s/m
MASS = np.diag([1e5] * 6 + [0.0])  # kg; the base comes last and is massless
STRETCH = (np.eye(7) - np.roll(np.eye(7), 1, axis=0))[:6]  # of a spring: its floor less the one below
DURATION, BAND, STROKE = 2400.0, (0.03, 0.6), 0.01  # s, Hz, m


def building():
    """The true structure."""
    K, C = (STRETCH.T @ np.diag(values) @ STRETCH for values in (SPRINGS, DAMPERS))
    sensors = [sysid.Sensor(f"floor {i + 1}", (0.0, 0.0, 3.0 * (i + 1)), "x") for i in range(6)]
    return sysid.Structure(MASS, K, damping_matrix=C[:6, :6], n_base=1, sensors=sensors)


def shake(truth, noise, rng):
    """The test: one run, the base with the same displacement at every line."""
    freq = np.arange(np.ceil(BAND[0] * DURATION), np.floor(BAND[1] * DURATION) + 1) / DURATION
    base = STROKE * (2 * np.pi * freq) ** 2
    response = base * truth.transmissibility(freq)[:, 0]
    std = noise * np.sqrt(np.mean(np.abs(response) ** 2))
    error = np.random.default_rng(rng).normal(scale=np.sqrt(0.5), size=(2, *response.shape))
    response += std * (error[0] + 1j * error[1])
    given = {"rigid_body": truth.rigid_body, "sensors": truth.sensors, "response_std": std if noise else None}
    return sysid.Measurement(freq, base[None, None].astype(complex), response[None], **given)


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("six_springs is simulated and takes no --data")
    truth = building()
    test = shake(truth, noise, rng)
    k = sysid.Variable("spring", 6, lower=5e4, upper=1e6, log=True, unit="N/m")
    c = sysid.Variable("damper", 6, lower=200.0, upper=20000.0, log=True, unit="N s/m")
    return sysid.Problem(
        test,
        mass=MASS,
        stiffness=STRETCH.T @ ca.diag(k) @ STRETCH,
        damping=STRETCH.T @ ca.diag(c) @ STRETCH,
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
