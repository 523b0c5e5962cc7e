"""Three-storey shear building from magnitudes of its transmissibility: the phase was not kept (simulated).

Sweep controllers often store the amplitude of each channel alone. The misfit is then written out,
(|T(w)| - measured) / ||measured||, with |T| the root of the sum of the squares of real and imaginary part. All floors
but the roof are weighed; its mass, springs and dampers are unknown. A magnitude does not tell a damper from its
negative: the bounds do. Without phase no poles can be found that would widen the peaks for a gradient: what finds the
fit is the guess, another start, or the swarm.
"""

from dataclasses import replace

import casadi as ca
import numpy as np

import sysid

FLOORS, ROOF = [900.0, 800.0], 700.0  # kg
SPRINGS, DAMPERS = np.array([1.2e6, 0.9e6, 0.7e6]), np.array([2500.0, 1500.0, 1200.0])  # N/m, N s/m, from the base up
STRETCH = np.array([[1, 0, 0, -1], [-1, 1, 0, 0], [0, -1, 1, 0]])  # of a storey: its floor less the one below


def building():
    """The true structure."""
    K, C = (STRETCH.T @ np.diag(values) @ STRETCH for values in (SPRINGS, DAMPERS))
    sensors = [sysid.Sensor(f"floor {i + 1}", (0.0, 0.0, 3.0 * (i + 1)), "x") for i in range(3)]
    return sysid.Structure(np.diag([*FLOORS, ROOF, 0.0]), K, damping_matrix=C[:3, :3], n_base=1, sensors=sensors)


def problem(*, data=None, rng=0, noise=0.0):
    if data is not None:
        raise sysid.InputError("magnitude_only is simulated and takes no --data")
    truth = building()
    test = sysid.simulate(truth, np.linspace(0.5, 14.0, 250), noise=noise, rng=rng)
    measured = np.abs(test.response[0])
    roof = sysid.Variable("roof mass", lower=200.0, upper=2000.0, unit="kg")
    k = sysid.Variable("spring", 3, lower=1e5, upper=1e7, log=True, unit="N/m")
    c = sysid.Variable("damper", 3, lower=100.0, upper=20000.0, log=True, unit="N s/m")
    M = ca.diag(ca.vertcat(*FLOORS, roof, 0.0))
    K, C = STRETCH.T @ ca.diag(k) @ STRETCH, STRETCH.T @ ca.diag(c) @ STRETCH
    a = sysid.FurtherTest(test, mass=M, stiffness=K, damping=C).response
    magnitude, floor = np.sqrt(a.real**2 + a.imag**2), np.abs(truth.transmissibility(test.freq)[:, 0]) - measured
    return sysid.Problem(
        replace(test, response=measured[None], response_std=None),  # no phase is left in it
        mass=M,
        stiffness=K,
        damping=C,
        misfit=(magnitude - measured) / np.linalg.norm(measured),
        reference=truth,
        goal=1e-6 if noise == 0 else 1.05 * np.linalg.norm(floor) / np.linalg.norm(measured),  # 5 % above the noise
    )
