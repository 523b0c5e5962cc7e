"""Write the stored results beside this file, formats 1 and 2, and what was in them (expected.json).

Run once, with the sysid of commit cfd962a, which writes these formats and has the names used here; later ones read
the files only. Format 1 holds problems of models alone, format 2 problems in expressions.
"""

import dataclasses
import json
import math
from pathlib import Path

import casadi as ca
import numpy as np

import sysid

HERE = Path(__file__).parent
FREQ = np.linspace(1.0, 30.0, 30)  # Hz
ONE = np.ones((2, 1))
MASSES, SPRINGS, DAMPERS = np.array([3.0, 2.0]), np.array([2e4, 1.5e4]), np.array([8.0, 5.0])  # kg, N/m, N s/m
STRETCH = np.eye(2) - np.eye(2, k=-1)
SENSORS = (sysid.Sensor("floor 1", (0.0, 0.0, 1.0), "x"), sysid.Sensor("Dach – oben", (0.1, 0.2, 2.0), (1.0, 0.0, 0.0)))


def storeys(k):
    """Matrix of two springs or dampers in series, of numbers or expressions."""
    return STRETCH.T @ np.diag(k) @ STRETCH if isinstance(k, np.ndarray) else ca.DM(STRETCH).T @ ca.diag(k) @ STRETCH


def with_base(K):
    return np.block([[K, -K @ ONE], [-ONE.T @ K, ONE.T @ K @ ONE]])


def building(masses=MASSES, **options):
    """Two floors."""
    options = options or {"damping_matrix": storeys(DAMPERS), "sensors": SENSORS}
    return sysid.Structure(np.diag([*masses, 0.0]), with_base(storeys(SPRINGS)), n_base=1, **options)


def table(n, d, seed):
    """A structure with a full mass matrix, n degrees of freedom and d base directions."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((n + d, n + d))
    mass = root @ root.T / n + 3 * np.eye(n + d)
    G = np.array([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]])[:n, :d]
    spring = rng.standard_normal((n, n))
    K = 4e4 * (spring @ spring.T + np.eye(n))
    return mass, np.block([[K, -K @ G], [-G.T @ K, G.T @ K @ G]])


def unknown(name, values, **options):
    values = np.asarray(values)
    return sysid.Variable(name, values.shape, lower=values / 3, upper=values * 3, guess=values * 1.1, **options)


def lumped():
    """Format 1: lumped mass weighed by a base force, stated noise, goal, validation, reference, a recipe."""
    truth = building(damping_ratios=[0.02, 0.03], sensors=SENSORS)
    test = sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=0)
    other = sysid.simulate(truth, FREQ[::2], noise=0.02, rng=1)
    problem = sysid.Problem(test, mass=sysid.LumpedMass(), reference=truth, validation=[other], goal=0.05)
    return dataclasses.replace(sysid.identify(problem, rng=0), recipe=sysid.Recipe("problems/häuser.py", "data", 3))


def open_masses():
    """Format 1: full mass and spectral stiffness, two base directions, no force: masses stay open."""
    truth = sysid.Structure(*table(3, 2, 5), [0.01, 0.02, 0.015], n_base=2)
    f = truth.natural_frequencies
    test = sysid.simulate(truth, np.linspace(0.5 * f[0], 1.2 * f[-1], 30), base_axes="yx")
    return sysid.identify(
        sysid.Problem(test, mass=sysid.FullMass(healing="rigid_body"), stiffness=sysid.SpectralStiffness(f)), rng=1
    )


def known_entries():
    """Format 1: a full mass of which a rigid-body mass and some entries are stated."""
    mass, stiffness = table(2, 2, 3)
    truth = sysid.Structure(mass, stiffness, [0.01, 0.02], n_base=2)
    f = truth.natural_frequencies
    test = sysid.simulate(truth, np.linspace(0.5 * f[0], 1.2 * f[-1], 30), noise=0.001, rng=2)
    known = [[mass[0, 0], np.nan, np.nan, np.nan], [np.nan, np.nan, mass[1, 2], np.nan]]
    model = sysid.FullMass(truth.rigid_body_mass, healing="rigid_body", known=known)
    stiffness = sysid.SpectralStiffness(f, max_frequency=2 * f[-1])
    return sysid.identify(
        sysid.Problem(test, mass=model, stiffness=stiffness, damping=sysid.ModalDamping(0.001, 0.1)), rng=2**70
    )


def more_modes():
    """Format 1: three modes at two sensors, so that no unknowns stand for the structure, and a recovery."""
    mass, stiffness = table(3, 1, 4)
    truth = sysid.Structure(
        mass, stiffness, [0.01, 0.02, 0.015], n_base=1, recovery=np.eye(3)[:2], rigid_body=[[1.0], [0.6]]
    )
    f = truth.natural_frequencies
    test = sysid.simulate(truth, np.linspace(0.5 * f[0], 1.2 * f[-1], 40), force=True)
    return sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=3)


def chain():
    """Format 1: springs of a chain, proportional damping."""
    truth = building(damping_matrix=0.5 * np.diag(MASSES) + 2e-4 * storeys(SPRINGS))
    problem = sysid.Problem(
        sysid.simulate(truth, FREQ, noise=0.01, rng=0), mass=sysid.LumpedMass([5.0]),
        stiffness=sysid.ChainStiffness(1e3, [1e5, 2e5]), damping=sysid.ProportionalDamping((0.0, 5.0), (0.0, 1e-2)),
    )  # fmt: skip
    return sysid.identify(problem, rng=0)


def searched(**options):
    """A known mass beside a spectrum and proportional damping, by a short swarm."""
    problem = sysid.Problem(
        sysid.simulate(building(), FREQ, noise=0.01, rng=0), mass=np.diag(MASSES),
        stiffness=sysid.SpectralStiffness(building().natural_frequencies),
        damping=sysid.ProportionalDamping((0.0, 5.0), (0.0, 1e-2)),
    )  # fmt: skip
    return sysid.identify(problem, rng=0, strategy=sysid.Swarm(max_iterations=8, n_particles=15, restarts=0), **options)


def swarm():
    """Format 1: the end of a swarm and its local phase."""
    return searched()


def interrupted():
    """Format 1: the same, stopped with Ctrl-C."""

    def stop(progress):
        if progress.iteration >= 5:
            raise KeyboardInterrupt

    return searched(callback=stop)


def expressions():
    """Format 2: prior, residual, further test, constraints, healing, recovery, a fixed and a logarithmic variable."""
    R = np.array([[1.0, 0.0], [0.4, 0.6], [0.0, 1.0]])
    m, k, c = unknown("m", MASSES, unit="kg"), unknown("k", SPRINGS, log=True, unit="N/m"), unknown("c", DAMPERS)
    added = sysid.Variable("added", lower=0, upper=2, guess=0.7, fixed=True, unit="kg")
    one, seen = building(), building(MASSES + np.array([0, 0.7]))
    wide = sysid.Structure(
        one.mass, one.stiffness, n_base=1, damping_matrix=one.damping, recovery=R, rigid_body=R @ ONE
    )
    second = sysid.simulate(seen, FREQ[::2], noise=0.01, force=True, rng=1)
    later = ca.diag(ca.vertcat(m[0], m[1] + added))
    problem = sysid.Problem(
        sysid.simulate(wide, FREQ, noise=0.01, rng=0), mass=ca.diag(m), stiffness=storeys(k), damping=storeys(c),
        recovery=R, rigid_body_dofs=ONE,
        residuals=[
            0.1 * (k[0] / k[1] - 4 / 3), sysid.Known(k[1], 1.55e4, 500.0), sysid.Known(c, [8.2, 4.9], 0.5),
            sysid.Misfit(second, mass=later, stiffness=storeys(k), damping=storeys(c)),
        ],
        constraints=[m[1] <= m[0], ca.sum1(m) == 5.02], healing={m: 5.02 * m / ca.sum1(m)}, goal=0.05,
    )  # fmt: skip
    return sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=2))


def own_misfit():
    """Format 2: sizes of the responses without their phases, in the place of the measurement's misfit."""
    m, k, c = unknown("m", MASSES, fixed=True), unknown("k", SPRINGS), unknown("c", DAMPERS)
    test = sysid.simulate(building(), FREQ, noise=0.01, rng=0)
    made = sysid.Misfit(test, mass=ca.diag(m), stiffness=storeys(k), damping=storeys(c)).response
    size = np.abs(test.response[0])
    misfit = ca.vec(ca.sqrt(made.real**2 + made.imag**2) - size) / np.linalg.norm(size)
    problem = sysid.Problem(test, mass=ca.diag(m), stiffness=storeys(k), damping=storeys(c), misfit=misfit)
    return sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))


def beside_models():
    """Format 2: unknowns of models, one of a logarithmic scale, beside a variable and a constraint."""
    truth = building(damping_matrix=0.5 * np.diag(MASSES) + 2e-4 * storeys(SPRINGS))
    c = unknown("c", 0.5)
    problem = sysid.Problem(
        sysid.simulate(truth, FREQ, noise=0.01, rng=0), mass=sysid.LumpedMass(5.0), damping=c * np.diag(MASSES)
        + 2e-4 * storeys(SPRINGS), stiffness=sysid.ChainStiffness(1e3, 1e5), constraints=[c <= 0.6],
    )  # fmt: skip
    return sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))


def ratios():
    """Format 2: one damping ratio a mode, base mass and coupling, a matrix of unknowns, force."""
    M = np.block([[np.diag(MASSES), 0.02 * MASSES[:, None]], [0.02 * MASSES, 0.5]])
    truth = sysid.Structure(M, with_base(storeys(SPRINGS)), [0.02, 0.03], n_base=1)
    k, z = sysid.Variable("k", (2, 1), lower=1e3, upper=1e5, guess=SPRINGS[:, None]), unknown("z", [0.02, 0.03])
    mu = sysid.Variable("mu", lower=0.0, upper=0.1, guess=0.01)
    mass = ca.blockcat([[np.diag(MASSES), mu * MASSES], [mu * MASSES[None], 0.5]])
    problem = sysid.Problem(
        sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=0), mass=mass, stiffness=storeys(k), damping=z
    )
    return sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))


def single():
    """Format 2: one degree of freedom and the model of its one damping ratio."""
    k = unknown("k", 1e4)
    one = sysid.Structure(np.diag([2.0, 0]), 1e4 * np.array([[1, -1], [-1, 1.0]]), [0.02], n_base=1)
    problem = sysid.Problem(
        sysid.simulate(one, FREQ, noise=0.01, rng=0), mass=[[2.0]], stiffness=k, damping=sysid.ModalDamping()
    )
    return sysid.identify(problem, rng=0, strategy=sysid.Continuation(starts=1))


KINDS = (
    lumped, open_masses, known_entries, more_modes, chain, swarm, interrupted, expressions, own_misfit, beside_models,
    ratios, single,
)  # fmt: skip
STRUCTURE = (
    "mass", "stiffness", "damping", "damping_ratios", "modal_damping", "recovery", "rigid_body", "n_base", "sensors",
)  # fmt: skip
MEASUREMENT = (
    "freq", "base", "response", "rigid_body", "force", "sensors", "response_std", "force_std", "base_axes",
)  # fmt: skip
RESULT = (
    "x", "strategy", "seed", "success", "message", "determined", "closed_by", "undetermined", "remarks", "interrupted",
)  # fmt: skip


def attributes(thing, names):
    """What the file holds of a thing, by the names of its attributes; None where there is none."""
    return None if thing is None else {name: getattr(thing, name) for name in names}


def names_of(thing):
    return [field.name for field in dataclasses.fields(thing)]


def contents(it):
    """What is compared: "stored" number by number, "computed" to round-off."""
    written, problem, u = it.problem.is_written, it.problem, it.uncertainty
    stored = attributes(it, RESULT) | {
        "structure": attributes(it.structure, STRUCTURE),
        "measurement": attributes(it.measurement, MEASUREMENT),
        "history": attributes(it.history, names_of(it.history)),
        "recipe": it.recipe and attributes(it.recipe, names_of(it.recipe)),
        "problem": attributes(problem, ("goal", "lower", "upper"))
        | {
            "reference": attributes(problem.reference, STRUCTURE),
            "validation": [attributes(test, MEASUREMENT) for test in problem.validation],
        },
    }
    models = {} if written else {name: getattr(problem, name) for name in ("mass", "stiffness", "damping")}
    stored["problem"] |= {name: attributes(model, names_of(model)) for name, model in models.items()}
    if written:
        stored["values"] = it.values
    computed = {
        "residual": it.residual,
        "force_residual": it.force_residual,
        "structure": {"natural_frequencies": it.structure.natural_frequencies},
        "further_tests": [
            [attributes(test, MEASUREMENT), attributes(s, ("mass", "stiffness", "damping"))]
            for test, s in it.further_tests
        ],
        "problem": {"totals": problem.totals},
    }
    deviations = attributes(u, ("natural_frequencies", "damping_ratios", "mass", "stiffness", "damping", "variables"))
    return {
        "format": 2 if written else 1,
        "models": {name: type(model).__name__ for name, model in models.items()},
        "stored": stored,
        "computed": computed,
        "objective": problem.misfit_of(it.x) if written else None,
        "uncertainty": deviations,
    }


def plain(value):
    """What JSON knows: complex arrays by their two parts, NaN as a text, objects by their attributes."""
    if dataclasses.is_dataclass(value):
        return plain(attributes(value, names_of(value)))
    if isinstance(value, dict):
        return {key: plain(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return (
            {"real": plain(value.real), "imag": plain(value.imag)} if np.iscomplexobj(value) else plain(value.tolist())
        )
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return str(value) if isinstance(value, float) and not math.isfinite(value) else value


def main():
    rows = []
    for make in KINDS:
        it = make()
        path = it.save(HERE / f"{make.__name__}.h5")
        row = json.dumps(plain(contents(it)), separators=(",", ":"), ensure_ascii=False, allow_nan=False)
        rows.append(f'"{make.__name__}":{row}')
        print(f"{path.name}: {path.stat().st_size} bytes, {it!r}, {it.strategy}, {len(it.history.log)} lines of log")
    (HERE / "expected.json").write_text("{\n" + ",\n".join(rows) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
