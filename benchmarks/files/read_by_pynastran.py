"""Read m.op4 and m.bdf of a folder by pyNastran and write what was read to read.npz: for an environment of its own.

It pins an old NumPy, so that neither sysid nor the benchmarks are imported: ``PYTHON read_by_pynastran.py FOLDER``.
"""

import sys
from pathlib import Path

import numpy as np
from pyNastran.bdf.bdf import BDF
from pyNastran.op4.op4 import OP4


def main(folder: Path) -> None:
    """Read and write; matrices of the bulk data are named in lower case, with the points of their columns."""
    found = {name: matrix.data for name, matrix in OP4(debug=False).read_op4(str(folder / "m.op4")).items()}
    model = BDF(debug=None)
    model.read_bdf(str(folder / "m.bdf"), punch=True, xref=False)
    for name, entry in model.dmig.items():
        matrix, _, columns = entry.get_matrix(is_sparse=False, apply_symmetry=True)
        found[name.lower()] = matrix
        found[f"{name.lower()}_columns"] = np.array([columns[k] for k in range(len(columns))])
    np.savez(folder / "read.npz", **found)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
