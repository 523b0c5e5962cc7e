"""Delays by phases far below the first mode, beside damping that turns these too."""

import numpy as np

import sysid
from benchmarks.channels.real_frames import FIRST, delays_by_phase


def test_damping_far_below_the_first_mode_is_no_delay():
    M, K = np.diag([2.0, 2, 2, 1]), np.array([[2.0, -1, 0, -1], [-1, 2, -1, 0], [0, -1, 1, 0], [-1, 0, 0, 1]])
    first = sysid.Structure(M, K, np.full(3, 0.02), n_base=1).natural_frequencies[0]
    frame = sysid.Structure(M, K * (FIRST / first) ** 2, np.full(3, 0.02), n_base=1)
    delays, tests = np.array([0.0, -5e-4, 2e-3]), []
    for centre in (1.5, 2.0):
        freq = np.linspace(centre - 0.1, centre + 0.1, 21)
        seen = frame.transmissibility(freq)[:, 0] * np.exp(-2j * np.pi * freq * delays[:, None])
        base = np.ones((1, 1, freq.size))
        tests.append(sysid.Measurement(freq, base, seen[None], rigid_body=np.ones((3, 1))))
    np.testing.assert_allclose(delays_by_phase(tests), delays, atol=2e-5)
    phase = -np.angle(tests[1].response[0]) / (2 * np.pi * tests[1].freq)
    assert phase[0].min() > 2e-4
