r"""Time records of base-shake tests, simulated without the package's spectra, two ways that check each other.

The base acceleration is a sum of cosines whose frequencies are not lines of the record. Each mode obeys

.. math:: \ddot q + 2 \zeta w \dot q + w^2 q = f = -\gamma u_0'', \qquad \lambda = w (-\zeta + i \sqrt{1 - \zeta^2}),

so that the record, which is cut in motion, is known in closed form: steady state at each cosine, and free vibration
``Re(c exp(lambda t))``. The other way is a recursion at 50 times the rate, exact for a base acceleration that is linear
between its samples: ``q = Im(z) / w_d`` with ``z' = lambda z + f``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import gcd

import numpy as np
import scipy.linalg
import scipy.signal

import sysid

LONGER = 1.3  # the motion's period over the record's duration, at least
FACTOR = 50  # rate of the recursion over that of the record


@dataclass(frozen=True, eq=False)
class Modes:
    """Modal model of a structure with classical damping, from its matrices alone.

    Attributes
    ----------
    omega, zeta : (n,)
        rad/s, fractions of critical damping.
    gamma : (n, d)
        Participations.
    shapes : (n_sensors, n)
        Mass-normalised, at the sensors.
    rigid_body : (n_sensors, d)
    rigid_body_mass : (d, d)
    """

    omega: np.ndarray
    zeta: np.ndarray
    gamma: np.ndarray
    shapes: np.ndarray
    rigid_body: np.ndarray
    rigid_body_mass: np.ndarray

    @classmethod
    def of(cls, structure: sysid.Structure) -> Modes:
        """Solve the eigenvalue problem of the matrices anew."""
        n, M, K = structure.n, structure.mass, structure.stiffness
        squares, vectors = scipy.linalg.eigh(K[:n, :n], M[:n, :n])
        omega = np.sqrt(squares)
        loss = vectors.T @ structure.damping @ vectors
        if not np.allclose(loss, np.diag(np.diag(loss)), atol=1e-8 * np.max(np.abs(loss))):
            raise ValueError("the damping is not classical: it couples modes")
        G = -np.linalg.solve(K[:n, :n], K[:n, n:])
        rigid = np.vstack([G, np.eye(structure.n_base)])
        return cls(
            omega, np.diag(loss) / (2 * omega), vectors.T @ (M[:n, :n] @ G + M[:n, n:]),
            structure.recovery @ vectors, structure.rigid_body, rigid.T @ M @ rigid,
        )  # fmt: skip

    @property
    def poles(self) -> np.ndarray:
        """Poles with positive imaginary parts, (n,), rad/s."""
        return self.omega * (-self.zeta + 1j * np.sqrt(1 - self.zeta**2))


@dataclass(frozen=True, eq=False)
class Motion:
    """A base acceleration that is a sum of cosines, one a line of a period longer than the record.

    Attributes
    ----------
    amplitudes : (d, lines), complex
        Of ``Re(amplitude exp(i w t))``, at the multiples of ``sample_rate / period``; the first line is zero.
    period : int
        Samples; shares no divisor with the number of samples of the record, so that no other line coincides.
    samples : int
        Of the record.
    sample_rate : float
        Hz.
    """

    amplitudes: np.ndarray
    period: int
    samples: int
    sample_rate: float

    @property
    def omega(self) -> np.ndarray:
        """Frequencies of the cosines, (lines,), rad/s."""
        return 2 * np.pi * np.arange(self.amplitudes.shape[1]) * self.sample_rate / self.period

    def in_time(self, amplitudes: np.ndarray, factor: int = 1) -> np.ndarray:
        """``Re(sum of amplitudes exp(i w t))`` over the record at `factor` times its rate; its last sample included."""
        length = factor * self.period
        whole = np.fft.irfft(amplitudes, n=length, axis=-1) * (length / 2)
        return whole[..., : factor * (self.samples - 1) + 1]


def random_motion(
    rng: np.random.Generator, duration: float, sample_rate: float, band: tuple[float, float], *,
    correlation: np.ndarray | None = None, power: float = 0.0, rms: float = 1.0,
) -> Motion:  # fmt: skip
    """Gaussian base motion of one rms in each direction.

    Parameters
    ----------
    duration, sample_rate : float
        s, Hz.
    band : (low, high)
        Hz, where the cosines are; `high` below half the sample rate.
    correlation : (d, d), optional
        Of the base directions; one direction by default.
    power : float
        Exponent of the power spectrum: 0 for white motion, -2 for one whose power falls as 1/f².
    rms : float
        m/s².
    """
    assert 0 < band[0] < band[1] < sample_rate / 2
    samples = round(duration * sample_rate)
    period = int(np.ceil(LONGER * samples))
    while gcd(period, samples) > 1:
        period += 1
    freq = np.arange(period // 2 + 1) * sample_rate / period
    inside = (freq >= band[0]) & (freq <= band[1])
    size = np.zeros(freq.size)
    size[inside] = freq[inside] ** (power / 2)
    correlation = np.eye(1) if correlation is None else np.asarray(correlation)
    drawn = rng.standard_normal((2, len(correlation), freq.size))
    amplitudes = np.linalg.cholesky(correlation) @ (drawn[0] + 1j * drawn[1]) * (rms * size / np.linalg.norm(size))
    return Motion(amplitudes, period, samples, sample_rate)


@dataclass(frozen=True, eq=False)
class Records:
    """Records of one run.

    Attributes
    ----------
    base, force : (d, n_samples)
        m/s², N.
    response : (n_sensors, n_samples)
        Absolute, m/s².
    sample_rate : float
        Hz.
    """

    base: np.ndarray
    response: np.ndarray
    force: np.ndarray
    sample_rate: float


@dataclass(frozen=True, eq=False)
class Levels:
    """Standard deviations of the noise of a sample: (d,) m/s², (n_sensors,) m/s², (d,) N."""

    base: np.ndarray
    response: np.ndarray
    force: np.ndarray


def with_noise(
    records: Records, rng: np.random.Generator, fraction: float, base_fraction: float | None = None
) -> tuple[Records, Levels]:
    """Add white noise, a fraction of each channel's rms, and give its standard deviations."""
    share = {"base": fraction if base_fraction is None else base_fraction, "response": fraction, "force": fraction}
    clean = {name: getattr(records, name) for name in share}
    std = {name: share[name] * np.sqrt(np.mean(record**2, axis=1)) for name, record in clean.items()}
    noisy = {
        name: record + std[name][:, None] * rng.standard_normal(record.shape) if share[name] else record
        for name, record in clean.items()
    }
    return Records(**noisy, sample_rate=records.sample_rate), Levels(**std)


@dataclass(frozen=True, eq=False)
class Run:
    """A structure in motion: base motion, and free vibration beside the steady state that it makes.

    Attributes
    ----------
    modes : Modes
    motion : Motion
    free : (n,), complex
        Modal displacements ``Re(free exp(lambda t))``.
    """

    modes: Modes
    motion: Motion
    free: np.ndarray

    @classmethod
    def ringing(cls, modes: Modes, motion: Motion, rng: np.random.Generator) -> Run:
        """With free vibration at the first sample that is as large as the steady state."""
        run = cls(modes, motion, np.zeros(modes.omega.size, dtype=complex))
        rms = np.sqrt(np.sum(np.abs(run.steady_state) ** 2, axis=1) / 2)
        return cls(modes, motion, rms * (rng.standard_normal(rms.size) + 1j * rng.standard_normal(rms.size)))

    @property
    def steady_state(self) -> np.ndarray:
        """Modal displacements at each cosine, (n, lines), complex."""
        w, wk = self.motion.omega, self.modes.omega[:, None]
        answer = 1 / (wk**2 - w**2 + 2j * self.modes.zeta[:, None] * wk * w)
        return -(self.modes.gamma @ self.motion.amplitudes) * answer

    def state(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Modal displacement and velocity, (n,) each, at a time after the first sample, s."""
        steady = self.steady_state * np.exp(1j * self.motion.omega * time)
        free = self.free * np.exp(self.modes.poles * time)
        displacement = np.sum(steady.real, axis=1) + free.real
        return displacement, np.sum((1j * self.motion.omega * steady).real, axis=1) + (self.modes.poles * free).real

    def records(self) -> Records:
        """In closed form: the steady state summed line by line, and the free vibration."""
        motion, poles = self.motion, self.modes.poles
        time = np.arange(motion.samples) / motion.sample_rate
        acceleration = motion.in_time(-(motion.omega**2) * self.steady_state)
        acceleration = acceleration + ((self.free * poles**2)[:, None] * np.exp(np.outer(poles, time))).real
        return self._records(motion.in_time(motion.amplitudes), acceleration)

    def records_by_recursion(self, factor: int = FACTOR) -> Records:
        """By a recursion at `factor` times the rate, exact for what is linear between its samples."""
        modes, step = self.modes, 1 / (factor * self.motion.sample_rate)
        base = self.motion.in_time(self.motion.amplitudes, factor)
        displacement, velocity = self.state(0.0)
        acceleration = np.empty((modes.omega.size, self.motion.samples))
        for k, pole in enumerate(modes.poles):
            load = -modes.gamma[k] @ base
            # z(t + h) = E z(t) + h (phi_1 - phi_2) f(t) + h phi_2 f(t + h); the exponential holds E, phi_1 and phi_2.
            E, first, second = scipy.linalg.expm(np.array([[pole * step, 1, 0], [0, 0, 1], [0, 0, 0]]))[0]
            # q = Im z / w_d and q' = Im(lambda z) / w_d at the first sample
            initial = velocity[k] - pole.real * displacement[k] + 1j * pole.imag * displacement[k]
            driven = step * ((first - second) * load[:-1] + second * load[1:])
            later = scipy.signal.lfilter([1.0], [1.0, -E], driven, zi=np.array([E * initial]))[0]
            z = np.concatenate([[initial], later])
            acceleration[k] = ((pole**2 * z).imag / pole.imag + load)[::factor]
        return self._records(base[:, ::factor], acceleration)

    def _records(self, base: np.ndarray, acceleration: np.ndarray) -> Records:
        modes = self.modes
        return Records(
            base,
            modes.shapes @ acceleration + modes.rigid_body @ base,
            modes.gamma.T @ acceleration + modes.rigid_body_mass @ base,
            self.motion.sample_rate,
        )


@dataclass(frozen=True, eq=False)
class Setting:
    """A structure, and how it is tested.

    Attributes
    ----------
    structure : sysid.Structure
    duration, sample_rate : float
        s, Hz.
    lines : (low, high)
        Hz: the band that is fitted.
    motion : (low, high)
        Hz: the band of the base motion.
    correlation : (d, d)
        Of the base directions.
    power : float
        Exponent of the power spectrum of the base motion.
    noise, base_noise : float
        Over each channel's rms.
    """

    structure: sysid.Structure
    duration: float
    sample_rate: float
    lines: tuple[float, float]
    motion: tuple[float, float]
    correlation: np.ndarray
    power: float = 0.0
    noise: float = 0.01
    base_noise: float = 0.01

    def run(self, rng: np.random.Generator, duration: float | None = None, strength: float = 1.0) -> Run:
        """One draw of the motion, cut at both ends; of another duration or rms where they are given."""
        modes = Modes.of(self.structure)
        motion = random_motion(
            rng, duration or self.duration, self.sample_rate, self.motion,
            correlation=self.correlation, power=self.power, rms=strength,
        )  # fmt: skip
        return Run.ringing(modes, motion, rng)

    def with_noise(self, records: Records, rng: np.random.Generator) -> tuple[Records, Levels]:
        """Records with noise of this setting, and its levels."""
        return with_noise(records, rng, self.noise, self.base_noise)


def softened(run: Run, share: float, factor: int = 8) -> Records:
    """Records of a run whose first natural frequency falls by a share of it along the record, from rest in that mode.

    The mode's equation is solved from step to step at `factor` times the rate, its stiffness constant in each and the
    load that of its middle: the error falls with the square of the step.
    """
    modes, motion = run.modes, run.motion
    still = replace(modes, gamma=np.vstack([np.zeros((1, modes.gamma.shape[1])), modes.gamma[1:]]))
    others = Run(still, motion, np.concatenate([[0.0], run.free[1:]])).records()
    base = motion.in_time(motion.amplitudes, factor)
    load, step = -modes.gamma[0] @ base, 1 / (factor * motion.sample_rate)
    omega = modes.omega[0] * (1 - share * np.arange(load.size) / load.size)
    damper = 2 * modes.zeta[0] * modes.omega[0]
    pole = -damper / 2 + 1j * np.sqrt(omega**2 - damper**2 / 4)
    passed = np.exp(pole * step)
    q, v, acceleration = 0.0, 0.0, np.empty(load.size)
    for i, (w, a, f) in enumerate(zip(omega, passed, load, strict=True)):
        acceleration[i] = f - damper * v - w**2 * q
        middle = (f + load[min(i + 1, load.size - 1)]) / 2 / w**2  # displacement that the load holds it at
        z = a * (v - pole[i].conjugate() * (q - middle))  # v - pole* q oscillates as exp(pole t)
        q, v = middle + z.imag / pole[i].imag, (pole[i] * z).imag / pole[i].imag
    a = acceleration[::factor][: motion.samples]
    return replace(
        others,
        response=others.response + modes.shapes[:, :1] * a,
        force=others.force + modes.gamma[0][:, None] * a,
    )


STOREY_MASSES = (560.0, 500.0, 460.0, 420.0)  # kg, from the ground
STOREY_STIFFNESSES = (1.45e6, 1.05e6, 8.0e5, 5.8e5)  # N/m
STOREY_RATIOS = (0.012, 0.014, 0.017, 0.020)
TABLE_MASS = 300.0  # kg, above the load cells and below the first storey


def four_storeys(table: float = TABLE_MASS, top: float = STOREY_STIFFNESSES[-1]) -> Setting:
    """A chain of four storeys, all floors measured, on a table, kg: 120 s at 200 Hz, 1 % noise on every channel.

    `top` is the stiffness of the uppermost storey, N/m.
    """
    k = np.array([*STOREY_STIFFNESSES[:-1], top])
    K = np.zeros((5, 5))
    for i, below in enumerate([4, 0, 1, 2]):  # what each storey stands on; the table comes last
        K[np.ix_([below, i], [below, i])] += k[i] * np.array([[1, -1], [-1, 1]])
    structure = sysid.Structure(np.diag([*STOREY_MASSES, table]), K, STOREY_RATIOS, n_base=1)
    return Setting(structure, 120.0, 200.0, (1.0, 20.0), (0.5, 50.0), np.eye(1))


NEIGHBOURS = (1.04, 1.6)  # a natural frequency over the one before
RATIOS = (0.005, 0.03)
PERIODS = (20, 200)  # of the first mode
NOISES = (0.003, 0.05)
SAMPLES = (5.0, 12.0)  # a period of the highest mode
WEAK, WEAKER = 0.1, (0.5, 2.5)  # share of modes that the base moves less, and by how many decades


def coupled(seed: int) -> Setting:
    """A structure with full mass and stiffness matrices, and a test of it; the same seed gives the same ones."""
    rng = np.random.default_rng((seed, 8))
    n, d = int(rng.integers(4, 11)), int(rng.integers(1, 4))
    f = 10 ** rng.uniform(-0.3, 0.9) * np.cumprod([1.0, *np.exp(rng.uniform(*np.log(NEIGHBOURS), n - 1))])
    weak = 10 ** -np.where(rng.random(n) < WEAK, rng.uniform(*WEAKER, n), 0.0)
    structure = coupled_structure(rng, n, d, f, weak)
    rate = float(rng.uniform(*SAMPLES) * f[-1])
    mixing = rng.standard_normal((d, d)) + 1.5 * np.eye(d)
    covariance = mixing @ mixing.T
    size = np.sqrt(np.diag(covariance))
    noise = float(np.exp(rng.uniform(*np.log(NOISES))))
    return Setting(
        structure,
        duration=float(np.exp(rng.uniform(*np.log(PERIODS))) / f[0]),
        sample_rate=rate,
        lines=(0.6 * f[0], min(1.3 * f[-1], 0.45 * rate)),
        motion=(0.4 * f[0], min(1.5 * f[-1], 0.45 * rate)),
        correlation=covariance / np.outer(size, size),
        power=float(rng.choice([0.0, -2.0])),
        noise=noise,
        base_noise=noise,
    )


def coupled_structure(
    rng: np.random.Generator, n: int, d: int, frequencies: np.ndarray, weak: np.ndarray | None = None
) -> sysid.Structure:
    """A structure with full matrices and natural frequencies (n,), Hz; `weak` multiplies participations, (n,)."""
    Q = _orthogonal(rng, n + d)
    M = (Q * 10 ** rng.uniform(1.0, 2.0, n + d)) @ Q.T
    # At least one sensor a direction, in any order.
    G = np.eye(d)[rng.permutation(np.concatenate([np.arange(d), rng.integers(d, size=n - d)]))]
    half = np.linalg.cholesky(M[:n, :n]) @ _orthogonal(rng, n)
    K = (half * (2 * np.pi * frequencies) ** 2) @ half.T
    if weak is not None:
        left = M[n:, n:] - M[n:, :n] @ np.linalg.solve(M[:n, :n], M[:n, n:])
        gamma = np.linalg.solve(half, M[:n, :n] @ G + M[:n, n:])
        M[:n, n:] = half @ (weak[:, None] * gamma) - M[:n, :n] @ G
        M[n:, :n] = M[:n, n:].T
        M[n:, n:] = left + M[n:, :n] @ np.linalg.solve(M[:n, :n], M[:n, n:])  # which keeps M positive definite
    K = np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]])
    return sysid.Structure((M + M.T) / 2, (K + K.T) / 2, rng.uniform(*RATIOS, n), n_base=d)


def _orthogonal(rng: np.random.Generator, n: int) -> np.ndarray:
    """An orthogonal matrix, uniform over all of them (Mezzadri, Notices of the AMS 54 (2007) 592)."""
    q, r = np.linalg.qr(rng.standard_normal((n, n)))
    return q * np.sign(np.diag(r))
