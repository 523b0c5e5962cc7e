"""Points spread over the unit cube."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def latin_hypercube(count: int, size: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Points (count, size): in each direction one in each of `count` slices.

    The draws are those of ``scipy.stats.qmc.LatinHypercube``, whose import takes longer than many a fit.

    References
    ----------
    M. D. McKay, R. J. Beckman, W. J. Conover, Technometrics 21 (1979) 239-245.
    """
    rng = rng.spawn(1)[0]
    inside = rng.uniform(size=(count, size))
    slices = np.tile(np.arange(1, count + 1), (size, 1))
    for row in slices:
        rng.shuffle(row)
    return np.asarray((slices.T - inside) / count)
