"""Two masses on one moving base, each on its own spring and tied to each other."""

import numpy as np

import sysid


def problem(*, data=None, rng=0):
    mass, k = np.diag([2.0, 1.0, 0.5]), 4e3
    stiffness = k * np.array([[2.0, -1.0, -1.0], [-1.0, 2.5, -1.5], [-1.0, -1.5, 2.5]])
    truth = sysid.Structure(mass, stiffness, [0.01, 0.02], n_base=1)
    test = sysid.simulate(truth, np.linspace(1.0, 25.0, 60), noise=0.0, rng=rng)
    freq, base, response, G = test.freq.copy(), test.base.copy(), test.response.copy(), test.rigid_body
    # a mistake goes here
    return sysid.Problem(
        sysid.Measurement(freq, base, response, rigid_body=G),
        mass=sysid.FullMass(3.5, healing="rigid_body"),
        stiffness=sysid.SpectralStiffness(truth.natural_frequencies),
        goal=1e-6,
    )
