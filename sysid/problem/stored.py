"""A problem in its own unknowns on disk: CasADi's functions as text, and the variables beside them.

The text is CasADi's own serialisation, which holds expressions and numbers and no Python.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np

from sysid.errors import InputError
from sysid.measurement.measurement import Measurement
from sysid.models.unknowns import Block, Variable, split
from sysid.problem.blocks import Known, Misfit
from sysid.problem.formulation import Formulation, Matrices, guess_of

Put = Callable[..., None]
Get = Callable[[Any, str], Any]


def write(
    group: Any, formulation: Formulation, put: Put, write_measurement: Callable[[Any, Measurement], None]
) -> None:
    """Store a formulation in a group; `put` stores values in groups."""
    for i, variable in enumerate((*formulation.variables, *formulation.fixed)):
        _write_variable(group.create_group(f"variables/{i}"), variable, put)
    _write_matrices(group.create_group("matrices"), formulation.matrices, put)
    for i, (test, matrices) in enumerate(formulation.others):
        write_measurement(group.create_group(f"others/{i}/measurement"), test)
        _write_matrices(group[f"others/{i}"], matrices, put)
    for name in ("residuals", "known", "misfit", "healing"):
        function = getattr(formulation, name)
        if function is not None:
            put(group, **{name: _text(name, function)})
    put(group, known_names=list(formulation.known_names))
    # JSON, as names may hold any character.
    put(group, members=json.dumps(formulation.members), declarations=json.dumps(formulation.declarations))
    constraints = formulation.constraints
    if constraints is not None:
        put(
            group.create_group("constraints"), function=_text("constraints", constraints.function),
            equal=np.array(constraints.lower == constraints.upper),
        )  # fmt: skip


def read(group: Any, get: Get, read_measurement: Callable[[Any], Measurement]) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a `Problem` is given to be the one that was stored, and what the functions do not tell of its formulation.

    Fixed variables are numbers in the stored functions, and names of what is known are gone.
    """
    stored = group["variables"]
    every = [_read_variable(stored[str(i)], get) for i in range(len(stored))]
    searched = [v for v in every if not v.fixed]
    x = ca.vertcat(*(ca.vec(v.symbol) for v in searched))
    given = _matrices(group["matrices"], x, get)
    others = group.get("others", {})
    residuals: list[Any] = [
        Misfit(read_measurement(others[str(i)]["measurement"]), **_matrices(others[str(i)], x, get))
        for i in range(len(others))
    ]
    if "residuals" in group:
        residuals.append(_function(group, "residuals", get)(x))
    if "known" in group:
        residuals.append(Known(_function(group, "known", get)(x), 0.0, 1.0))
    if "misfit" in group:
        given["misfit"] = _function(group, "misfit", get)(x)
    if "healing" in group:
        healed = split(searched, _function(group, "healing", get)(x))
        given["healing"] = {v: ca.reshape(part, *v.symbol.shape) for v, part in zip(searched, healed, strict=True)}
    constraints = []
    if "constraints" in group:
        rows = _function(group["constraints"], "function", get)(x)
        equal = np.atleast_1d(get(group["constraints"], "equal"))
        constraints = [rows[i] == 0 if same else rows[i] <= 0 for i, same in enumerate(equal.tolist())]
    untold = {
        "fixed": tuple(v for v in every if v.fixed),
        "known_names": tuple(get(group, "known_names") or ()),
        "members": tuple((name, tuple(names)) for name, names in json.loads(get(group, "members"))),
        "declarations": json.loads(get(group, "declarations")),
    }
    return {**given, "residuals": residuals, "constraints": constraints}, untold


def check_storable(formulation: Formulation) -> None:
    """Refuse what could not be stored at the end: a Python callback inside an expression."""
    functions = {"matrices": formulation.matrices.function, "residuals": formulation.residuals}
    functions |= {"known": formulation.known}
    functions |= {"misfit": formulation.misfit, "healing": formulation.healing}
    functions |= {f"matrices of test {i}": m.function for i, (_, m) in enumerate(formulation.others, start=2)}
    if formulation.constraints is not None:
        functions["constraints"] = formulation.constraints.function
    for name, function in functions.items():
        if function is not None:
            _text(name, function)


def _text(name: str, function: ca.Function) -> str:
    try:
        text = str(function.serialize())
        ca.Function.deserialize(text)  # a callback is written without a word, and then cannot be read
        return text
    except (RuntimeError, NotImplementedError):
        raise InputError(
            f"{name}: a Python callback in an expression cannot be stored, nor sent to another machine; write it in "
            "CasADi's own operations"
        ) from None


def _function(group: Any, name: str, get: Get) -> ca.Function:
    return ca.Function.deserialize(get(group, name))


def _write_matrices(group: Any, matrices: Matrices, put: Put) -> None:
    put(
        group, function=_text("matrices", matrices.function), rigid_body_dofs=matrices.rigid_body_dofs,
        recovery=matrices.recovery,
    )  # fmt: skip
    put(group.attrs, by_ratios=matrices.by_ratios)


def _matrices(group: Any, x: ca.MX, get: Get) -> dict[str, Any]:
    M, M_S0, M_00, K, damping = _function(group, "function", get)(x)[:5]
    recovery = get(group, "recovery")
    at_sensors = np.array_equal(recovery, np.eye(len(recovery)))
    return {
        "mass": ca.blockcat([[M, M_S0], [M_S0.T, M_00]]),
        "stiffness": K,
        "damping": [damping] if get(group.attrs, "by_ratios") and K.numel() == 1 else damping,
        "recovery": None if at_sensors else recovery,
        "rigid_body_dofs": get(group, "rigid_body_dofs"),
    }


def _write_variable(group: Any, variable: Block | Variable, put: Put) -> None:
    shape = variable.shape if isinstance(variable, Variable) else (variable.size,)
    put(
        group, name=variable.name, unit=variable.unit, lower=variable.lower, upper=variable.upper,
        guess=guess_of(variable), shape=list(map(str, shape)),
    )  # fmt: skip
    if isinstance(variable, Variable):
        put(group.attrs, log=variable.log, fixed=variable.fixed, guessed=variable.has_guess)


def _read_variable(group: Any, get: Get) -> Variable:
    shape = tuple(map(int, get(group, "shape") or ()))
    lower, upper, guess = (
        np.reshape(get(group, name), shape, order="F") for name in ("lower", "upper", "guess")
    )  # fmt: skip
    return Variable(
        get(group, "name"), shape, lower=lower, upper=upper, unit=get(group, "unit") or "",
        guess=guess if get(group.attrs, "guessed") or get(group.attrs, "fixed") else None,
        log=bool(get(group.attrs, "log")), fixed=bool(get(group.attrs, "fixed")),
    )  # fmt: skip
