"""Units of channels: what quantity a unit is of, and its factor to SI."""

from __future__ import annotations

import math
import re
from typing import NamedTuple

from sysid.errors import InputError, shown

STANDARD_GRAVITY = 9.80665  # m/s²
POUND = 4.4482216152605  # N
INCH = 0.0254  # m


class Unit(NamedTuple):
    """A quantity, and the factor that takes a number in this unit to SI."""

    quantity: str
    factor: float


_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": INCH, "ft": 12 * INCH}
_FORCES = {"N": 1.0, "mN": 1e-3, "kN": 1e3, "MN": 1e6, "lbf": POUND, "kip": 1e3 * POUND}

UNITS: dict[str, Unit] = {
    **{name: Unit("displacement", size) for name, size in _LENGTHS.items()},
    **{f"{name}/s": Unit("velocity", size) for name, size in _LENGTHS.items()},
    **{f"{name}/s2": Unit("acceleration", size) for name, size in _LENGTHS.items()},
    "g": Unit("acceleration", STANDARD_GRAVITY),
    "mg": Unit("acceleration", 1e-3 * STANDARD_GRAVITY),
    "ug": Unit("acceleration", 1e-6 * STANDARD_GRAVITY),
    "gal": Unit("acceleration", 1e-2),
    **{name: Unit("force", size) for name, size in _FORCES.items()},
    **{f"{name}m": Unit("moment", size) for name, size in _FORCES.items() if name.endswith("N")},
    "rad/s2": Unit("angular acceleration", 1.0),
    "deg/s2": Unit("angular acceleration", math.radians(1)),
    "s": Unit("time", 1.0),
    "ms": Unit("time", 1e-3),
    "us": Unit("time", 1e-6),
    "deg": Unit("angle", math.radians(1)),
    "rad": Unit("angle", 1.0),
    "Hz": Unit("frequency", 1.0),
    "kHz": Unit("frequency", 1e3),
    "rad/s": Unit("frequency", 1 / (2 * 3.141592653589793)),
}
_OTHER_WORDS = {
    "ms-2": "m/s2", "gn": "g", "gs": "g", "lb": "lbf", "newton": "N", "newtons": "N",
    "degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad",
    "hz": "Hz", "kn": "kN", "n": "N", "G": "g", "g's": "g",
}  # fmt: skip


def find(text: str) -> Unit | None:
    """The unit that a text names, such as "m/s²", "mm/s^2", "g" or "kN"; None where it names none."""
    plain = text.strip().replace("²", "2").replace("µ", "u").replace("μ", "u").replace("°", "deg")
    for sign in (" ", "^", "*", "·"):
        plain = plain.replace(sign, "")
    plain = re.sub("sec(onds?)?", "s", plain.replace("(", "").replace(")", ""), flags=re.IGNORECASE)
    plain = plain.replace("/s/s", "/s2")
    return UNITS.get(_OTHER_WORDS.get(plain, plain)) or UNITS.get(_OTHER_WORDS.get(plain.lower(), plain.lower()))


_RATIOS = {
    "kg": (UNITS["N"], UNITS["m/s2"]),
    "1/kg": (UNITS["m/s2"], UNITS["N"]),
    **dict.fromkeys(("1", "-", "dimensionless"), (Unit("", 1.0), Unit("", 1.0))),
}


def ratio(text: str, of: str) -> tuple[Unit, Unit]:
    """Units of what a function is, and of what it is per unit of: of "m/s²/N", "g / N", "kg".

    The quantity of the latter is "" where it is per nothing; of a number per the same, such as "1", that of both is.
    """
    plain, nothing = text.strip(), Unit("", 1.0)
    if plain in _RATIOS:
        return _RATIOS[plain]
    cuts = [match.start() for match in re.finditer("/", plain)]
    pairs = [(find(plain[:cut]), find(plain[cut + 1 :])) for cut in cuts]
    both = [(above, below) for above, below in pairs if above is not None and below is not None]
    if find(plain) is None and both:
        return both[0]
    return unit(plain, of), nothing


def unit(text: str, of: str) -> Unit:
    """The unit that a text names, or an InputError that says of what it is none."""
    known = find(text)
    if known is None:
        raise InputError(
            f"the unit {shown(text)} of {of} is not known: m/s², mm/s², g, N, kN, lbf and their like are; state it "
            "with unit= in the description of the sensor"
        )
    return known
