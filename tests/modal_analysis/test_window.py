"""What Hann's window makes of the poles of functions H1, in closed form, and functions without it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy

import sysid
from sysid.measurement.spectra import blurred
from sysid.modal_analysis.direct_terms import under_hann, without_window

SECONDS = 12.0  # three lines in a half-power width
FREQ = np.arange(48, 600) / SECONDS
RATIOS = (0.01, 0.004)


def test_a_pole_under_hann_is_its_impulse_response_times_the_autocorrelation_of_the_window() -> None:
    """By numbers: the window's autocorrelation by Fourier's theorem, the transform by Simpson's rule."""
    n = 1 << 15
    window = scipy.signal.get_window("hann", n)
    own = np.fft.irfft(np.abs(np.fft.rfft(window, 2 * n)) ** 2)[:n]
    time = np.arange(n) * SECONDS / n
    poles = 2 * np.pi * np.array([12.3, 31.0]) * np.exp(1j * (np.pi / 2 + np.arcsin(RATIOS)))
    freq = FREQ[::8]  # of each line a sum over all samples
    for pole, found in zip(poles, under_hann(freq, poles, SECONDS), strict=True):
        inside = own / own[0] * np.exp(np.subtract.outer(pole, 2j * np.pi * freq)[:, None] * time)
        np.testing.assert_allclose(found, scipy.integrate.simpson(inside, x=time, axis=1), rtol=2e-4)


def test_simulated_h1_of_white_noise_is_the_closed_form_and_not_the_plain_one() -> None:
    """A pair of poles as a digital filter of the same impulse response, 4,000 blocks."""
    n, rate, pole = 1024, 512.0, 2 * np.pi * 12.3 * np.exp(1j * (np.pi / 2 + np.arcsin(0.01)))
    rng, z = np.random.default_rng(0), np.exp(pole / rate)
    x = rng.standard_normal(4000 * n)
    y = scipy.signal.lfilter([2.0, -2 * z.real], [1.0, -2 * z.real, abs(z) ** 2], x) / rate
    blocks = [np.fft.rfft(scipy.signal.get_window("hann", n) * one.reshape(4000, n)) for one in (x, y)]
    H1 = np.mean(blocks[1] * blocks[0].conj(), axis=0) / np.mean(np.abs(blocks[0]) ** 2, axis=0)
    lines = np.arange(18, 32)
    freq = lines / 2.0
    hann = under_hann(freq, np.array([pole, pole.conj()]), 2.0).sum(axis=0)
    plain = 1 / (2j * np.pi * freq - pole) + 1 / (2j * np.pi * freq - pole.conj())
    off = [np.linalg.norm(H1[lines] - one) / np.linalg.norm(plain) for one in (hann, plain)]
    assert off[0] < 0.02
    assert off[1] > 5 * off[0]


def functions(late: float = 0.0, ratios: tuple[float, float] = RATIOS, noise: float = 0.002):
    """Two sensors and a force under Hann's window: the test as an analyser has it, and the true one without."""
    rng, omega, zeta = np.random.default_rng(1), 2 * np.pi * np.array([12.3, 31.0]), np.array(ratios)
    pole = omega * np.exp(1j * (np.pi / 2 + np.arcsin(zeta)))
    phi, gamma = np.array([[1.0, 0.5], [1.5, -0.7]]), np.array([1.1, 0.6])
    residue = -(pole**2) / (2j * pole.imag)
    hann = [
        r * a + r.conj() * b - 1
        for r, a, b in zip(
            residue, under_hann(FREQ, pole, SECONDS), under_hann(FREQ, pole.conj(), SECONDS), strict=True
        )
    ]
    w = 2 * np.pi * FREQ
    plain = w**2 / (omega[:, None] ** 2 - w**2 + 2j * (zeta * omega)[:, None] * w)
    tests = []
    for g in (np.array(hann), plain):
        H = 1 + (phi * gamma) @ g
        H[1] *= np.exp(-1j * w * late)
        F = 10 + gamma**2 @ g
        size = [noise * np.hypot(np.abs(one), 1.0) for one in (H, F)]
        drawn = (rng.standard_normal((3, FREQ.size, 2)) @ [1, 1j]) / np.sqrt(2)
        tests.append(
            sysid.Measurement.from_frf(
                FREQ,
                H + drawn[:2] * size[0],
                force=(F + drawn[2] * size[1])[None, None],
                rigid_body=np.ones((2, 1)),
                response_std=size[0][:, None],
                force_std=size[1][None, None],
                base_axes="x",
                window="hann",
                averages=40,
            )
        )
    return tests[0], replace(tests[1], window=""), omega, zeta, phi * gamma


def test_the_window_is_taken_off_once_and_modes_of_what_is_left_are_right_within_deviations() -> None:
    given, true, omega, zeta, _ = functions()
    turned = without_window(given)
    assert turned.window == "taken off"
    assert without_window(turned) is turned
    before, after = (np.abs(one.response - true.response) / true.response_std for one in (given, turned))
    assert np.max(before) > 10
    assert np.sqrt(np.mean(after**2)) < 2  # two draws of noise
    answer = sysid.identify(sysid.Problem(given), rng=0)
    s, std = answer.structure, answer.uncertainty
    assert np.all(np.abs(s.natural_frequencies - omega / (2 * np.pi)) < 4 * std.natural_frequencies)
    assert np.all(np.abs(s.damping_ratios - zeta) < 4 * std.damping_ratios)
    plain = sysid.identify(sysid.Problem(replace(given, window="")), rng=0)
    assert answer.judgement == "determined"
    assert plain.judgement in ("doubtful", "no fit")


def test_delays_of_functions_under_hann_are_found() -> None:
    given = functions(late=2e-3)[0]
    delays = sysid.identify(sysid.Problem(given), rng=0).modal[0].delays
    np.testing.assert_array_equal(delays.values != 0, [False, True, False])
    assert abs(delays.values[1] - 2e-3) < 4 * delays.std[1] < 2e-4


def test_uneven_lines_keep_the_window_among_their_errors_and_the_word_is_stored() -> None:
    given = functions()[0]
    uneven = replace(given, freq=given.freq**1.01)
    turned = without_window(uneven)
    np.testing.assert_array_equal(turned.response, uneven.response)
    np.testing.assert_allclose(turned.response_std**2, uneven.response_std**2 + blurred(uneven.response) ** 2)
    assert sysid.Measurement.from_tree(given.to_tree()).window == "hann"
    assert without_window(replace(given, window="")).window == ""
    with pytest.raises(sysid.InputError, match="window"):
        sysid.Measurement.from_frf(FREQ, given.response[0], rigid_body=np.ones((2, 1)), window="flat top")


def test_lines_that_are_not_all_of_their_blocks_keep_what_the_window_blurs_among_their_errors() -> None:
    given = functions()[0]
    thin = given.at(np.arange(given.freq.size) % 2 == 0)
    turned = without_window(thin)
    assert turned.window == ""
    np.testing.assert_array_equal(turned.response, thin.response)
    np.testing.assert_allclose(turned.response_std**2, thin.response_std**2 + blurred(thin.response) ** 2)


def test_what_the_window_makes_of_a_pole_narrower_than_a_line_counts_among_the_errors() -> None:
    """Against true functions: errors over deviations, which without that are some tens."""
    given, true, *_ = functions(ratios=(0.01, 0.001), noise=2e-4)
    turned = without_window(given)
    off = np.abs(turned.response - true.response)
    assert np.max(off / given.response_std) > 10
    assert np.sqrt(np.mean((off / turned.response_std) ** 2)) < 2


def test_a_zero_among_functions_is_no_reason_to_keep_the_window() -> None:
    given = functions()[0]
    H, std = given.response.copy(), given.response_std.copy()
    H[0, 0, 5] = std[0, 0, 5] = 0.0
    assert without_window(replace(given, response=H, response_std=std)).window == "taken off"


def test_units_of_functions_without_deviations_do_not_decide_whether_a_window_is_taken_off() -> None:
    """Functions without any window, stated to have one: lines are explained worse without it, in any units."""
    true = functions(noise=1e-4)[1]
    for unit in (1e-3, 1e3):
        stated = replace(true, window="hann", response_std=None, force_std=None, force=unit * true.force)
        assert without_window(stated).window == ""


def test_a_number_of_blocks_is_a_whole_number() -> None:
    given = functions()[0]
    for wrong in ("40", 2.5, -5):
        with pytest.raises(sysid.InputError, match="averages"):
            sysid.Measurement.from_frf(FREQ, given.response[0], rigid_body=np.ones((2, 1)), averages=wrong)
