"""A test that `sysid read` wrote: full or lumped masses, stiffness by its modes, a damping ratio a mode.

--data names the file; `sysid run test.h5` is short for `sysid run recorded_test --data test.h5`.
"""

import dataclasses

import sysid
from sysid.files import recorded_test


def problem(
    *, data=None, rng=0, mass=None, lumped=False, band=None, goal=None, estimator=None, at_rest=None, gain_std=None,
    amplitude=False,
):  # fmt: skip
    """`mass`: kg, one or one a direction, of all or, `lumped`, at the sensors; `band`: (low, high), Hz; `goal`.

    `gain_std`: tolerance of the gains of all channels, base and force included; `amplitude`: the first mode follows its
    amplitude.
    """
    if data is None:
        raise sysid.InputError("recorded_test needs a test: sysid run test.h5, with what 'sysid read' wrote")
    asked = {"band": band, "estimator": estimator, "at_rest": at_rest}
    test = recorded_test.load(data).measurement(**{name: value for name, value in asked.items() if value is not None})
    if gain_std is not None:
        test = dataclasses.replace(test, gain_std=gain_std, base_gain_std=gain_std, force_gain_std=gain_std)
    masses = sysid.LumpedMass(mass) if lumped else sysid.FullMass(mass, healing="rigid_body")
    return sysid.Problem(test, mass=masses, goal=goal, amplitude=sysid.AmplitudeLaw() if amplitude else None)
