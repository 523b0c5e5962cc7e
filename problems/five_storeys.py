"""Five-storey shear building, masses known, storey stiffnesses and damping unknown (simulated; Civil Eng. J. 5830).

The case of a published comparison of particle swarm, differential evolution and genetic algorithm at 5 % noise. Its
numbers are not at hand: the masses, the stiffnesses, and Rayleigh's damping here are round ones of our own, with 2 %
of critical damping in the first and in the third mode. The base is shaken evenly at the lines from 0.2 to 12 Hz.
"""

import casadi as ca
import numpy as np

import sysid

MASSES = np.array([30e3, 30e3, 30e3, 30e3, 25e3])  # kg
SPRINGS = np.array([40e6, 36e6, 32e6, 28e6, 24e6])  # N/m, from the base up
RATIO, TUNED = 0.02, (0, 2)  # damping ratio of these modes
STRETCH = (np.eye(6) - np.roll(np.eye(6), 1, axis=0))[:5]  # of a storey: its floor less the one below; the base last
MASS, STIFFNESS = np.diag([*MASSES, 0.0]), STRETCH.T @ np.diag(SPRINGS) @ STRETCH


def building():
    """The true structure."""
    w = 2 * np.pi * sysid.Structure(MASS, STIFFNESS, np.zeros(5), n_base=1).natural_frequencies[list(TUNED)]
    alpha, beta = 2 * RATIO * np.array([w[0] * w[1], 1.0]) / w.sum()
    C = alpha * MASS + beta * STIFFNESS
    sensors = [sysid.Sensor(f"floor {i + 1}", (0.0, 0.0, 3.0 * (i + 1)), "x") for i in range(5)]
    return sysid.Structure(MASS, STIFFNESS, damping_matrix=C[:5, :5], n_base=1, sensors=sensors)


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("five_storeys is simulated and takes no --data")
    truth = building()
    test = sysid.simulate(truth, np.arange(0.2, 12.0, 0.02), noise=noise, rng=rng)
    k = sysid.Variable("storey stiffness", 5, lower=5e6, upper=2e8, log=True, unit="N/m")
    alpha = sysid.Variable("alpha", lower=0.0, upper=2.0, unit="1/s")
    beta = sysid.Variable("beta", lower=0.0, upper=0.01, unit="s")
    K = STRETCH.T @ ca.diag(k) @ STRETCH
    return sysid.Problem(
        test,
        mass=MASS,
        stiffness=K,
        damping=alpha * MASS + beta * K,
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
