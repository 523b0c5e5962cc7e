"""Axial stack on force cells: no mass is known, all are weighed by the base force (simulated).

An adapter ring, then a tank, a platform and two units on it, in one direction. A base-drive test between shaker and
force cells gives the apparent mass, f0 = B' a + M_rb u0'' with B = M_SS G, beside the accelerations (Wijker,
Mechanical Vibrations in Spacecraft Design (2004), on effective masses). Masses, springs and modal damping are
unknown. Accelerations alone would leave the scale of everything open; the ring, below all sensors, shows in the
force only.
"""

import casadi as ca
import numpy as np

import sysid

NAMES = ("tank", "platform", "unit A", "unit B")
MASSES = np.array([420.0, 180.0, 60.0, 25.0, 40.0])  # kg; last the ring, which is the base
SPRINGS = np.array([6e7, 2.5e7, 1.2e7, 3e6])  # N/m: ring-tank, tank-platform, platform-unit A, platform-unit B
STRETCH = np.array([[1, 0, 0, 0, -1], [-1, 1, 0, 0, 0], [0, -1, 1, 0, 0], [0, -1, 0, 1, 0]])


def stack():
    """The true structure."""
    sensors = [sysid.Sensor(name, (0.0, 0.0, float(z)), "z") for z, name in enumerate(NAMES, start=1)]
    K = STRETCH.T @ np.diag(SPRINGS) @ STRETCH
    return sysid.Structure(np.diag(MASSES), K, [0.01, 0.015, 0.02, 0.012], n_base=1, sensors=sensors)


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("base_force is simulated and takes no --data")
    truth = stack()
    test = sysid.simulate(truth, np.linspace(10.0, 120.0, 220), noise=noise, force=True, rng=rng, base_axes="z")
    m = sysid.Variable("mass", 5, lower=2.0, upper=2000.0, log=True, unit="kg")
    # Unit B is on soft mounts: a guess that has both units alike would be a special point, of which records tell less.
    k = sysid.Variable("spring", 4, lower=5e5, upper=5e8, guess=[2e7, 2e7, 2e7, 2e6], log=True, unit="N/m")
    return sysid.Problem(
        test,
        mass=ca.diag(m),
        stiffness=STRETCH.T @ ca.diag(k) @ STRETCH,
        damping=sysid.ModalDamping(0.002, 0.08),
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * test.residual(truth),  # or 5 % above the noise floor
    )
