"""From time records to spectra: closed forms, time integration by SciPy, Monte Carlo statistics, resampling."""

import numpy as np
import pytest
import scipy.integrate
import scipy.signal

import sysid
from sysid import InputError, Measurement, resample
from sysid.measurement import spectra

RATE = 100.0


def white(rng, *shape):
    return rng.normal(size=shape)


class TestWholeRecord:
    @pytest.mark.parametrize("n", [200, 201])
    def test_sines_of_whole_periods_stand_on_their_own_lines(self, n):
        """rfft / rate of A cos(w t + p) over whole periods is A exp(ip) T / 2 on its line and zero elsewhere."""
        t = np.arange(n) / RATE
        duration = n / RATE
        lines, amplitude, phase = [3, 10, 41], [1.0, 0.3, 2.0], [0.4, -1.0, 2.5]
        x = sum(a * np.cos(2 * np.pi * k / duration * t + p) for k, a, p in zip(lines, amplitude, phase, strict=True))
        test = Measurement.from_time(
            [(x, np.vstack([2 * x + 5, -x]), 3 * x)], RATE, rigid_body=[[1.0], [0.0]], estimator="spectra"
        )
        np.testing.assert_allclose(test.freq, np.arange(1, n // 2 + 1) / duration, rtol=1e-12)
        expected = np.zeros(test.freq.size, complex)
        for k, a, p in zip(lines, amplitude, phase, strict=True):
            expected[k - 1] = a * np.exp(1j * p) * duration / 2
        np.testing.assert_allclose(test.base[0, 0], expected, atol=1e-12)
        np.testing.assert_allclose(test.response[0], [2 * expected, -expected], atol=1e-12)  # the offset is line zero
        np.testing.assert_allclose(test.force[0, 0], 3 * expected, atol=1e-12)

    def test_band(self):
        rng = np.random.default_rng(0)
        records = [(white(rng, 1, 500), white(rng, 2, 500), None)]
        full = Measurement.from_time(records, RATE, rigid_body=[[1], [1]])
        cut = Measurement.from_time(records, RATE, rigid_body=[[1], [1]], band=(5.0, 20.0))
        assert (cut.freq[0], cut.freq[-1]) == (5.0, 20.0)
        np.testing.assert_array_equal(cut.response, full.in_band(5, 20).response)

    @pytest.mark.parametrize("kind", ["ratios", "matrix"])
    def test_a_structure_integrated_in_time_answers_with_its_own_frequency_response(self, random_structure, kind):
        """Full partitioned equations under a multisine in two directions, by DOP853, once the transient has died."""
        rng = np.random.default_rng(4)
        s = random_structure(rng, n=2, d=2, frequencies=[3.0, 6.0], ratios=[0.25, 0.2])
        if kind == "matrix":
            C = s.damping + np.array([[30.0, -12.0], [-12.0, 5.0]])
            s = sysid.Structure(s.mass, s.stiffness, n_base=2, damping_matrix=C)
        M, K, C, G = s.mass, s.stiffness, s.damping, s.rigid_body
        lines = np.arange(2, 19, 2)  # of a period of 2 s: 1 to 9 Hz
        phase, w = rng.uniform(0, 2 * np.pi, (2, 2, lines.size)), np.pi * lines

        def base(t, run, order):
            """Base displacement of a run, differentiated `order` times; acceleration of unit amplitude a line."""
            return np.sum((1j * w) ** (order - 2) * np.exp(1j * (w * t + phase[run])), axis=-1).real

        powers = np.array([(1j * w) ** order for order in (-2, -1, 0)])
        drive = -np.linalg.solve(M[:2, :2], np.hstack([K[:2, 2:], -C @ G, M[:2, 2:]]))
        own = -np.linalg.solve(M[:2, :2], np.hstack([K[:2, :2], C]))

        def motion(t, state, run):
            shaken = (powers @ np.exp(1j * (w * t + phase[run])).T).real.ravel()
            return np.concatenate([state[2:], own @ state + drive @ shaken])

        rate, settle, period = 40.0, 7.0, 2.0  # slowest transient: exp(-0.25 * 2 pi 3 * 7) = 5e-15
        t = settle + np.arange(int(rate * period)) / rate
        records = []
        for run in range(2):
            answer = scipy.integrate.solve_ivp(
                motion, (0, t[-1]), np.zeros(4), "DOP853", t, args=(run,), rtol=1e-8, atol=1e-10
            )
            moving = np.array([motion(time, state, run)[2:] for time, state in zip(t, answer.y.T, strict=True)]).T
            shaking = np.array([base(time, run, 2) for time in t]).T
            force = np.einsum("ij,jt->it", M[2:, :2], moving) + M[2:, 2:] @ shaking
            u_0, v_0 = (np.array([base(time, run, order) for time in t]).T for order in (0, 1))
            relative_rate = answer.y[2:] - G @ v_0
            force += K[2:, :2] @ answer.y[:2] + K[2:, 2:] @ u_0 - G.T @ C @ relative_rate
            records.append((shaking, moving, force))
        test = Measurement.from_time(records, rate, rigid_body=G)
        excited = np.isin(np.round(test.freq * period).astype(int), lines)
        np.testing.assert_allclose(test.base[..., ~excited], 0, atol=1e-10)
        on = Measurement(
            test.freq[excited], test.base[..., excited], test.response[..., excited], rigid_body=G,
            force=test.force[..., excited],
        )  # fmt: skip
        assert on.residual(s) < 1e-6
        assert on.force_residual(s) < 1e-6


# A linear system with a short memory, so that windows bias nothing: y = sum_j filter_ij * x_j.
def filters(rng, outputs, inputs, taps=4):
    return rng.normal(size=(outputs, inputs, taps))


def answer(h, x):
    return np.array([sum(np.convolve(x[j], h[i, j])[: x.shape[1]] for j in range(x.shape[0])) for i in range(len(h))])


def true_response(h, freq):
    return np.einsum("ijt,tf->ijf", h, np.exp(-2j * np.pi * np.outer(np.arange(h.shape[2]), freq / RATE)))


class TestAveraged:
    G = np.zeros((2, 2))

    def one(self, rng, h, *, lengths=(4000, 3000, 5000), noise=0.0, base_noise=0.0, segment=128, kind="h1", d=2):
        """Runs with base motions that are correlated with each other, and forces as two further outputs."""
        mix = np.array([[1.0, 0.0], [0.6, 0.8]])[:d, :d]
        runs = []
        for n in lengths:
            x = mix @ white(rng, d, n + 50)
            y = answer(h, x)[:, 50:]
            x = x[:, 50:]
            y = y + noise * white(rng, *y.shape)
            runs.append((x + base_noise * white(rng, *x.shape), y[:2], y[2:] if len(h) > 2 else None))
        return Measurement.from_time(runs, RATE, rigid_body=np.zeros((2, d)), estimator=kind, segment=segment)

    @pytest.mark.parametrize("seed", range(2))
    def test_h1_separates_correlated_base_directions(self, seed):
        """Without noise only the window's leakage is left: (filter length / segment)² and its like, below 1 %."""
        rng = np.random.default_rng(seed)
        h = filters(rng, 4, 2)
        test = self.one(rng, h, segment=256)
        assert (test.n_runs, test.n_base, test.freq.size) == (2, 2, 128)
        expected = true_response(h, test.freq)
        H, F = np.moveaxis(test.response, 0, 1), np.moveaxis(test.force, 0, 1)
        assert np.linalg.norm(H - expected[:2]) < 0.02 * np.linalg.norm(expected[:2])
        assert np.linalg.norm(F - expected[2:]) < 0.02 * np.linalg.norm(expected[2:])
        np.testing.assert_array_equal(test.base[0, :, 5], [1, 0])

    def test_h1_with_noise_on_the_responses_is_unbiased_and_knows_its_error(self):
        """Over Monte Carlo tests: E|e|² / std² is 1 within 20 %, and the mean error shrinks like 1 / sqrt(tests)."""
        rng = np.random.default_rng(0)
        h = filters(rng, 4, 2, taps=3)
        tests, errors, squares, inner = 60, [], [], slice(2, -2)
        for _ in range(tests):
            test = self.one(rng, h, noise=1.0, lengths=(1500, 1200), segment=64)
            H = np.concatenate([test.response, test.force], axis=1).swapaxes(0, 1)[..., inner]
            std = np.concatenate([test.response_std, test.force_std], axis=1).swapaxes(0, 1)[..., inner]
            errors.append(H - true_response(h, test.freq)[..., inner])
            squares.append(np.abs(errors[-1]) ** 2 / std**2)
        per_output = np.mean(squares, axis=(0, 2, 3))
        np.testing.assert_allclose(per_output, 1, atol=0.2)
        left = np.sqrt(np.mean(np.abs(np.mean(errors, axis=0)) ** 2))
        scatter = np.sqrt(np.mean(np.abs(errors) ** 2))
        # 1 / sqrt(tests) if unbiased; twice that leaves room for the window's leakage.
        assert left < 2 * scatter / np.sqrt(tests)

    def test_h2_with_noise_on_the_base_is_unbiased_where_h1_is_not(self):
        """With noise of a third of the base's power H1 is low by 1 / (1 + 1/3); H2 is not."""
        rng = np.random.default_rng(1)
        h = filters(rng, 2, 1)
        level = np.sqrt(1 / 3)
        ratio = {"h1": [], "h2": []}
        for kind, found in ratio.items():
            for _ in range(6):
                test = self.one(rng, h, base_noise=level, lengths=(30000,), segment=128, kind=kind, d=1)
                expected = true_response(h, test.freq)
                H = np.moveaxis(test.response, 0, 1)
                found.append(np.vdot(expected, H).real / np.vdot(expected, expected).real)
        assert np.mean(ratio["h2"]) == pytest.approx(1, abs=0.02)
        assert np.mean(ratio["h1"]) == pytest.approx(0.75, abs=0.02)

    def test_h2_knows_its_error(self):
        rng = np.random.default_rng(2)
        h = filters(rng, 2, 1)
        squares = []
        for _ in range(40):
            test = self.one(rng, h, base_noise=0.2, lengths=(4000,), segment=64, kind="h2", d=1)
            e = np.abs(np.moveaxis(test.response, 0, 1) - true_response(h, test.freq))[..., 2:-2]
            squares.append(np.mean(e**2 / np.moveaxis(test.response_std, 0, 1)[..., 2:-2] ** 2))
        assert np.mean(squares) == pytest.approx(1, abs=0.3)

    @pytest.mark.parametrize("noise", [0.0, 0.5, 1e3])
    def test_coherence_is_what_the_base_explains(self, noise):
        """Between 0 and 1 always; of order (inputs / averages) without a relation, and one without noise."""
        rng = np.random.default_rng(3)
        h = filters(rng, 2, 2)
        runs = []
        for _ in range(2):
            x = white(rng, 2, 8000)
            runs.append(spectra.TimeRun(x, answer(h, x) + noise * white(rng, 2, 8000), None))
        estimate = spectra.averaged(runs, RATE, kind="h1", segment=128)
        inner = estimate.coherence[:, 2:-2]
        assert estimate.coherence.shape == (2, 64)
        assert np.all((estimate.coherence >= 0) & (estimate.coherence <= 1))
        H = true_response(h, estimate.freq)[..., 2:-2]
        signal_power = np.sum(np.abs(H) ** 2, axis=1)
        expected = signal_power / (signal_power + noise**2)
        assert np.mean(np.abs(inner - expected)) < 0.03

    def test_one_input_agrees_with_scipy(self):
        rng = np.random.default_rng(5)
        x, y = white(rng, 1, 3000), white(rng, 2, 3000)
        y = y + 2 * x
        test = Measurement.from_time([(x, y, None)], RATE, rigid_body=[[1], [1]], estimator="h1", segment=200)
        freq, S_xy = scipy.signal.csd(x, y, RATE, nperseg=200)
        _, S_xx = scipy.signal.welch(x, RATE, nperseg=200)
        np.testing.assert_allclose(test.freq, freq[1:], rtol=1e-12)
        np.testing.assert_allclose(test.response[0], (S_xy / S_xx)[:, 1:], rtol=1e-9, atol=1e-12)
        estimate = spectra.averaged([spectra.TimeRun(x, y, None)], RATE, kind="h1", segment=200)
        _, coherence = scipy.signal.coherence(x, y, RATE, nperseg=200)
        np.testing.assert_allclose(estimate.coherence, coherence[:, 1:], rtol=1e-9, atol=1e-12)
        _, S_yy = scipy.signal.welch(y, RATE, nperseg=200)
        h2 = Measurement.from_time([(x, y, None)], RATE, rigid_body=[[1], [1]], estimator="h2", segment=200)
        np.testing.assert_allclose(h2.response[0], (S_yy / S_xy.conj())[:, 1:], rtol=1e-9)

    def test_a_quarter_of_the_shortest_record_by_default(self):
        rng = np.random.default_rng(6)
        runs = [(white(rng, 1, n), white(rng, 1, n), None) for n in (1600, 900)]
        test = Measurement.from_time(runs, RATE, rigid_body=[[1]], estimator="h1")
        assert test.freq[0] == pytest.approx(RATE / 225)

    def test_effective_averages_of_a_hann_window_at_half_overlap(self):
        """Welch 1967: segments at half overlap with Hann correlate by 1/6, so their variance is 1/18 more, nearly."""
        window = scipy.signal.get_window("hann", 1024)
        n = 1000
        got = spectra._effective_averages(window, 512, np.array([n]))
        assert got == pytest.approx(n / (1 + 2 * (1 - 1 / n) / 36), rel=1e-4)


class TestMistakes:
    @staticmethod
    def run(n=400, d=2, sensors=2, rng=0):
        rng = np.random.default_rng(rng)
        return white(rng, d, n), white(rng, sensors, n), white(rng, d, n)

    @staticmethod
    def read(runs, rate=RATE, **options):
        return Measurement.from_time(runs, rate, **({"rigid_body": np.zeros((2, 2))} | options))

    @pytest.mark.parametrize("factor", [0.0, 2.0])
    def test_base_directions_that_do_not_move_independently(self, factor):
        x, y, _ = self.run(4000)
        runs = [(np.vstack([x[0], factor * x[0]]), y, None)]
        with pytest.raises(InputError, match=r"base direction"):
            self.read(runs, estimator="h1", segment=128)

    def test_two_runs_of_two_fixed_directions_are_independent(self):
        (x, y, _), (z, v, _) = self.run(3000), self.run(3000, rng=1)
        runs = [(np.vstack([x[0], 2 * x[0]]), y, None), (np.vstack([z[0], -z[0]]), v, None)]
        assert self.read(runs, estimator="h1", segment=128).n_runs == 2

    @pytest.mark.parametrize("rate", [0, -1.0, np.nan, np.inf])
    def test_sample_rate(self, rate):
        with pytest.raises(InputError, match="sample_rate"):
            self.read([self.run()], rate)

    @pytest.mark.parametrize("kind", ["spectra", "h1"])
    @pytest.mark.parametrize("which", range(3))
    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_samples_that_are_not_finite(self, kind, which, bad):
        run = self.run()
        run[which][0, 7] = bad
        name = ("base", "response", "force")[which]
        with pytest.raises(InputError, match=f"run 2, {name} holds NaN or infinite"):
            self.read([self.run(), run], estimator=kind)

    def test_shapes(self):
        x, y, f = self.run()
        with pytest.raises(InputError, match="runs has 0 entries; give a list of .base"):
            self.read([])
        with pytest.raises(InputError, match="run 1 has 2 entries"):
            self.read([(x, y)])
        with pytest.raises(InputError, match="run 1, base has shape"):
            self.read([(x[:1], y, f)])
        with pytest.raises(InputError, match="run 1, response has shape"):
            self.read([(x, np.vstack([y, y]), f)])
        with pytest.raises(InputError, match="run 1, force has shape"):
            self.read([(x, y, f[:1])])
        with pytest.raises(InputError, match="different lengths"):
            self.read([(x, y[:, 1:], f)])
        with pytest.raises(InputError, match="some runs have a force"):
            self.read([(x, y, f), (x, y, None)])
        with pytest.raises(InputError, match="not an array of real numbers"):
            self.read([("x", y, f)])

    def test_estimators(self):
        with pytest.raises(InputError, match="estimator = 'h3' is unknown"):
            self.read([self.run()], estimator="h3")
        with pytest.raises(InputError, match="use 'h1'"):
            self.read([self.run()], estimator="h2")

    @pytest.mark.parametrize("segment", [1, 0, -5, 401])
    def test_segments(self, segment):
        with pytest.raises(InputError, match="segment"):
            self.read([self.run()], estimator="h1", segment=segment)

    def test_too_few_segments_for_the_base_directions(self):
        with pytest.raises(InputError, match="cannot separate 2 base directions"):
            self.read([self.run()], estimator="h1", segment=300)

    def test_a_record_too_short_for_a_line(self):
        with pytest.raises(InputError, match="no spectral line"):
            self.read([self.run(1)])


class TestResample:
    @staticmethod
    def clocks(rng):
        """Three unequal clocks: other starts, rates within 1 %, jitter."""
        out = []
        for start, rate in ((0.0, 100.0), (0.313, 100.7), (0.127, 99.4)):
            t = start + np.arange(900) / rate
            out.append(t + rng.uniform(-0.1, 0.1, t.size) / rate)
        return out

    @pytest.mark.parametrize("seed", range(3))
    def test_cubic_polynomials_come_through_exactly(self, seed):
        rng = np.random.default_rng(seed)
        times = self.clocks(rng)
        polynomials = rng.normal(size=(3, 2, 4))
        value = lambda k, t: np.array([np.polyval(p, (t - 4) / 5) for p in polynomials[k]])  # noqa: E731
        time, samples = resample([(t, value(k, t)) for k, t in enumerate(times)])
        assert time[0] == max(t[0] for t in times)
        assert time[-1] <= min(t[-1] for t in times)
        rates = [(t.size - 1) / (t[-1] - t[0]) for t in times]
        np.testing.assert_allclose(np.diff(time), 1 / min(rates), rtol=1e-10)
        for k in range(3):
            assert samples[k].shape == (2, time.size)
            np.testing.assert_allclose(samples[k], value(k, time), atol=1e-10)

    def test_a_sine_well_inside_the_band_comes_through(self):
        """The interior error of a cubic spline is of order (w h)⁴ / 384 of the amplitude, taken tenfold for jitter."""
        times = self.clocks(np.random.default_rng(1))
        f = 5.0
        time, samples = resample([(t, np.sin(2 * np.pi * f * t)) for t in times])
        inner = slice(20, -20)
        bound = 10 * (2 * np.pi * f / 99.4) ** 4 / 384
        for x in samples:
            np.testing.assert_allclose(x[0, inner], np.sin(2 * np.pi * f * time[inner]), atol=bound)

    def test_a_faster_instrument_is_low_passed_and_not_delayed(self):
        slow, fast = np.arange(0, 20, 1 / 100), np.arange(0.0012, 20, 1 / 1000)
        f_in, f_out = 10.0, 130.0  # 130 Hz would fold to 30 Hz
        x = np.sin(2 * np.pi * f_in * fast) + np.sin(2 * np.pi * f_out * fast)
        time, (_, y) = resample([(slow, np.sin(2 * np.pi * f_in * slow)), (fast, x)])
        inner = (time > 2) & (time < 18)
        np.testing.assert_allclose(y[0, inner], np.sin(2 * np.pi * f_in * time[inner]), atol=1e-3)

    def test_a_lower_rate_may_be_asked_for(self):
        t = np.arange(0, 10, 0.01)
        time, (x,) = resample([(t, np.cos(2 * np.pi * t))], 40.0)
        np.testing.assert_allclose(np.diff(time), 1 / 40, rtol=1e-9)
        inner = (time > 1) & (time < 9)
        np.testing.assert_allclose(x[0, inner], np.cos(2 * np.pi * time[inner]), atol=1e-3)

    @pytest.mark.parametrize(
        ("match", "records", "rate"),
        [
            ("records has 0 entries", [], None),
            ("record 1: time", [([0, 1, 2], [1, 2, 3])], None),
            ("record 1: time", [(np.arange(5), np.ones((2, 6)))], None),
            (
                "of record 2 holds NaN",
                [(np.arange(9.0), np.ones(9)), (np.arange(9.0), np.full(9, np.nan))],
                None,
            ),
            ("time does not rise at sample 4", [([0, 1, 2, 2, 3.0], np.ones(5))], None),
            ("a gap of 5 s at 2 s", [([0, 1, 2, 7, 8, 9.0], np.ones(6))], None),
            ("no time in common", [(np.arange(9.0), np.ones(9)), (np.arange(20.0, 29), np.ones(9))], None),
            ("sample_rate = 2 Hz", [(np.arange(9.0), np.ones(9))], 2.0),
            ("sample_rate = 0 Hz", [(np.arange(9.0), np.ones(9))], 0.0),
        ],
    )
    def test_refusals(self, match, records, rate):
        with pytest.raises(InputError, match=match):
            resample(records, rate)

    @pytest.mark.parametrize(("match", "slow"), [("record 1: 9 samples are too few", 9), ("record 2: 14", 99)])
    def test_a_record_too_short_for_the_filter_is_refused(self, match, slow):
        """Where one is faster all are low-passed alike, the slow one too."""
        with pytest.raises(InputError, match=match):
            resample([(np.arange(float(slow)), np.ones(slow)), (np.arange(0, 4, 0.3), np.ones(14))])
