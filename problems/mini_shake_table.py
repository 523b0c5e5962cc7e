"""Three-storey frame on a shaker table, real records: fitted on one event, predicting another.

Wireless inertial units on the table and on each floor recorded two events of stepped harmonic motion along X and the
free decay after it. The model is fitted on the relative X accelerations of `sine_1p5` (spectra of the whole record,
0.3-25 Hz) and predicts those of `sine_2p0`, which the fit never sees. Floor masses and base force are not known:
masses are normalised to 1 kg.

With `amplitude` the whole records are fitted, and the first mode follows its amplitude: it softens by 2 to 3 %.
--data (or the variable SYSID_DATA) names the folder that holds both events.
"""

import os
from pathlib import Path

import numpy as np

import sysid
from sysid.files import xsens_dot

UNITS = ("ground", "floor_1", "floor_2", "floor_3")
BAND = (0.3, 25.0)  # Hz: above the drift of the offsets, below the noise of the units


def event(folder, estimator="spectra"):
    """One event as a measurement: the units on one clock, offsets removed, whole-record spectra.

    What the model misses here is larger than noise, so that all lines count alike: no transients, no levels of noise.
    """
    records = [xsens_dot.read_xsens_dot(folder / f"{unit}.csv") for unit in UNITS]
    time, (ground, *floors) = sysid.resample([(record.time, record.acceleration[:1]) for record in records])
    # Gravity leaks into X by the tilt of each unit.
    centred = [x - x.mean() for x in (ground, *floors)]
    return sysid.Measurement.from_time(
        [(centred[0], np.vstack(centred[1:]), None)],
        1 / (time[1] - time[0]),
        rigid_body=np.ones((3, 1)),
        estimator=estimator,
        band=BAND,
        sensors=[sysid.Sensor(f"floor {i}", (0.0, 0.0, float(i)), "x") for i in (1, 2, 3)],
    )


def problem(*, data=None, rng=0, amplitude=False):
    folder = data or os.environ.get("SYSID_DATA")
    if not folder:
        raise sysid.InputError("mini_shake_table needs its records: --data FOLDER, with sine_1p5 and sine_2p0 in it")
    events = [Path(folder) / name for name in ("sine_1p5", "sine_2p0")]
    if not all(path.is_dir() for path in events):
        raise sysid.InputError(
            f"{folder} does not hold the folders sine_1p5 and sine_2p0: --data names the one that does"
        )
    fitted, unseen = (event(path, "records" if amplitude else "spectra") for path in events)
    if amplitude:
        return sysid.Problem(fitted, amplitude=sysid.AmplitudeLaw(modes=[1]), validation=[unseen])
    return sysid.Problem(
        fitted,
        mass=sysid.FullMass(healing="rigid_body"),
        stiffness=sysid.SpectralStiffness([3.75, 11.2, 16.6]),
        validation=[unseen],
    )
