"""Exact derivatives of a record's squared error in modal coordinates, against complex sums and differences."""

import numpy as np
import pytest

from sysid.modal_analysis.modal_error import ModalError

SHAPE = {"runs": 2, "lines": 9, "channels": 4, "modes": 3, "directions": 2}


def drawn(with_base):
    """An error function, random coordinates, and the squared error by a plain loop over modes."""
    rng = np.random.default_rng(5)
    r, L, c, m, d = SHAPE.values()
    complex_ = lambda *shape: rng.standard_normal(shape) + 1j * rng.standard_normal(shape)  # noqa: E731
    base, record, freq = complex_(r, d, L), complex_(r, c, L), np.linspace(1.0, 4.0, L)
    channel, line = rng.uniform(0.5, 2, c), rng.uniform(0.5, 2, (r, L))
    error = ModalError(base, record, freq, channel, line, modes=m, with_base=with_base)
    A, B, gamma = rng.standard_normal((c, m)), rng.standard_normal((c, d)), rng.standard_normal((m, d))
    w, zeta = 2 * np.pi * rng.uniform(1, 4, m), rng.uniform(0.02, 0.2, m)
    parts = [A, B, gamma] if with_base else [A, gamma]
    y = np.concatenate([*(part.ravel(order="F") for part in parts), np.log(w), np.log(zeta)])

    total = 0.0
    for i in range(r):
        answer = B @ base[i] if with_base else np.zeros((c, L), dtype=complex)
        for k in range(m):
            s = 2 * np.pi * freq
            gain = s**2 / (w[k] ** 2 - s**2 + 2j * zeta[k] * w[k] * s)
            answer = answer + np.outer(A[:, k], gain * (gamma[k] @ base[i]))
        total += np.sum(np.abs(channel[:, None] * line[i] * (answer - record[i])) ** 2)
    return error, y, total


@pytest.mark.parametrize("with_base", [False, True])
def test_the_error_is_the_sum_over_runs_channels_and_lines(with_base):
    error, y, total = drawn(with_base)
    assert float(error.gradient(y)[0]) == pytest.approx(total, rel=1e-13)
    assert float(error.value(y)) == pytest.approx(total, rel=1e-13)


@pytest.mark.parametrize("with_base", [False, True])
def test_gradient_and_hessian_agree_with_differences(with_base):
    error, y, _ = drawn(with_base)
    gradient, hessian = np.asarray(error.gradient(y)[1]), np.asarray(error.hessian(y))
    h = 1e-5
    rng = np.random.default_rng(6)
    for _ in range(4):
        along = rng.standard_normal(y.size)
        steps = [error.gradient(y + k * h * along) for k in (-2, -1, 1, 2)]
        values, slopes = ([np.asarray(step[i]).ravel() for step in steps] for i in (0, 1))
        central = lambda v: (v[0] - 8 * v[1] + 8 * v[2] - v[3]) / (12 * h)  # noqa: E731  fourth order
        assert central(values).item() == pytest.approx((gradient.ravel() @ along).item(), rel=1e-8)
        assert central(slopes) == pytest.approx(hessian @ along, rel=1e-7, abs=1e-7 * np.abs(hessian).max())
