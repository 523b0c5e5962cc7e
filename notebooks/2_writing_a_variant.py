# %% [markdown]
# # Writing a variant
#
# You know how your structure is built: which floors a spring joins, which masses were weighed, where a damper sits. Say
# so, and sysid identifies *your* numbers: stiffnesses, masses, dampers, with their uncertainty, in place of full
# matrices. You will see
#
# 1. how unknowns are declared and matrices written of them;
# 2. what the data determine of them, and how an open scale shows;
# 3. two ways to close it: a relation that you know, and a second test with a known mass added;
# 4. further records, other residuals, and what to do where a search fails.
#
# The structure is simulated, so that every answer can be held against the truth.

# %%
import casadi as ca
import matplotlib.pyplot as plt
import numpy as np

import sysid

colours = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00"]  # told apart with any colour vision
plt.rcParams.update({"axes.prop_cycle": plt.cycler(color=colours), "axes.grid": True, "grid.color": "#e4e8ec"})
plt.rcParams.update({"axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False, "font.size": 9})

# %% [markdown]
# ## The structure and its test
#
# Three floors, one above the other, and an appendage on the second: a tank that hangs on a spring and a damper of its
# own. `STRETCH` has a row for each spring: by how much it stretches when a floor, or the base, moves by one. Every
# matrix of springs is then `STRETCH.T @ diag(k) @ STRETCH`. The rows of a structure come first, those of the base last.

# %%
#                    floor 1, 2, 3, tank, base
STRETCH = np.array([
    [1, 0, 0, 0, -1],  # floor 1 on the base
    [-1, 1, 0, 0, 0],
    [0, -1, 1, 0, 0],
    [0, -1, 0, 1, 0],  # the tank on floor 2
])  # fmt: skip
true = {
    "mass": np.array([120.0, 110.0, 90.0, 12.0]),  # kg
    "spring": np.array([4e5, 3e5, 2.5e5, 9e3]),  # N/m
    "damper": np.array([300.0, 250.0, 200.0, 60.0]),  # N s/m
}


def structure(mass, spring, damper):
    K, C = (STRETCH.T @ np.diag(values) @ STRETCH for values in (spring, damper))
    sensors = [
        sysid.Sensor(name, (0, 0, z), "x") for name, z in (("floor 1", 1), ("floor 2", 2), ("floor 3", 3), ("tank", 2))
    ]
    return sysid.Structure(np.diag([*mass, 0.0]), K, damping_matrix=C[:4, :4], n_base=1, sensors=sensors)


truth = structure(**true)
freq = np.linspace(1.0, 20.0, 120)  # Hz
test = sysid.simulate(truth, freq, noise=0.01, rng=1)
print("natural frequencies, Hz:", truth.natural_frequencies.round(2), " damping ratios:", truth.damping_ratios.round(4))

# %% [markdown]
# ## Unknowns and matrices
#
# A `Variable` has a name, a shape, and bounds: the widest that you believe. `log=True` is for what you know to an order
# of magnitude. From there on it is an expression: slices, sums and products with NumPy arrays, and CasADi's functions
# (`ca.diag`, `ca.vertcat`, `ca.sqrt`, ...) take it.
#
# A problem is the test and its three matrices: mass, stiffness, and damping `C` on the motion relative to the base.

# %%
m = sysid.Variable("mass", 4, lower=5.0, upper=300.0, unit="kg")
k = sysid.Variable("spring", 4, lower=1e3, upper=2e6, log=True, unit="N/m")
c = sysid.Variable("damper", 4, lower=5.0, upper=5e3, log=True, unit="N s/m")

M = ca.diag(ca.vertcat(m, 0.0))  # the base has no mass of its own
K = STRETCH.T @ ca.diag(k) @ STRETCH
C = (STRETCH.T @ ca.diag(c) @ STRETCH)[:4, :4]

problem = sysid.Problem(test, mass=M, stiffness=K, damping=C)
result = sysid.identify(problem, rng=0)
print(result.summary())

# %% [markdown]
# The fit is as good as the noise lets it be, and yet the result is *not determined*: masses, springs and dampers may
# all grow by the same share, and no accelerometer sees it. That is physics, not a failure of the search: accelerations
# weigh nothing. The sentence is computed from the exact Jacobian of this very problem, at this answer.
# The picture shows what was found, divided by the truth: one common factor.

# %%
fig, ax = plt.subplots(figsize=(7, 2.6), layout="constrained")
for name, values in true.items():
    ax.plot([f"{name}\n{i + 1}" for i in range(4)], result.values[name] / values, "o-", label=name)
ax.axhline(1.0, color="0.4", linewidth=0.8)
ax.set(ylabel="identified / true", title="Nothing in kilograms was stated: one common scale is open")
ax.legend(ncols=3)
ratio = np.concatenate([result.values[name] / values for name, values in true.items()])
assert np.ptp(ratio[:8]) < 0.02 * ratio.mean()  # masses and springs share the factor

# %% [markdown]
# ## Closing it with what you know
#
# The floors and the tank were weighed together: 332 kg. A constraint is a relation of variables; IPOPT holds it
# exactly. (For the particle swarm, which takes over where gradients find no good fit,
# `healing={m: 332 * m / ca.sum1(m)}` would scale each candidate to it.)
#
# The search above began at three points. For this problem the first of them, the guess, is enough: from here on
# `Continuation(starts=1)` takes a third of the time.

# %%
once = sysid.Continuation(starts=1)
weighed = sysid.Problem(test, mass=M, stiffness=K, damping=C, constraints=[ca.sum1(m) == 332.0])
result = sysid.identify(weighed, strategy=once, rng=0)
print(result.summary())
assert result.determined

# %%
fig, axes = plt.subplots(1, 3, figsize=(9, 2.8), layout="constrained")
for ax, (name, values) in zip(axes, true.items(), strict=True):
    error = 100 * (result.values[name] / values - 1)
    std = 100 * result.uncertainty.variables[name] / values
    ax.errorbar(range(1, 5), error, 1.96 * std, fmt="o", capsize=3)
    ax.axhline(0.0, color="0.4", linewidth=0.8)
    ax.set(title=name, xlabel="floor 1, 2, 3, tank", ylabel="error, %", xticks=range(1, 5))
fig.suptitle("Error against the truth, with 95 % intervals, 1 % noise")
worst = max(np.max(np.abs(result.values[n] - v) / result.uncertainty.variables[n]) for n, v in true.items())
print(f"largest error: {worst:.1f} standard deviations")
assert worst < 4

# %% [markdown]
# A weighing has an accuracy. `Prior` states a value with its standard deviation, and counts as one more measurement:
# here the tank alone, 12.2 kg give or take 0.2 kg. All masses then are as uncertain as that weighing.

# %%
tank = sysid.Prior(m[3], 12.2, std=0.2)
result = sysid.identify(sysid.Problem(test, mass=M, stiffness=K, damping=C, residuals=[tank]), strategy=once, rng=0)
mass, std = result.values["mass"], result.uncertainty.variables["mass"]
print("masses, kg:", *(f"{value:.1f} ± {1.96 * s:.1f}" for value, s in zip(mass, std, strict=True)))
print(*result.closed_by)

# %% [markdown]
# ## Closing it with a second test
#
# Nothing was weighed, but you can bolt 20 kg to the top floor and shake once more. A `FurtherTest` is a test of the
# structure *as it was then*: the same variables, and the known mass added. Both tests are fitted together.

# %%
added = np.diag([0.0, 0.0, 20.0, 0.0, 0.0])  # kg
heavier = structure(true["mass"] + np.diag(added)[:4], true["spring"], true["damper"])
second = sysid.simulate(heavier, freq, noise=0.01, rng=2)
both = sysid.Problem(
    test, mass=M, stiffness=K, damping=C, residuals=[sysid.FurtherTest(second, mass=M + added, stiffness=K, damping=C)]
)
result = sysid.identify(both, strategy=once, rng=0)
print(result.summary())
for name, values in true.items():
    told = [f"{100 * (x / v - 1):+.2f} ± {100 * 1.96 * s / v:.2f} %" for x, v, s in zip(
        result.values[name], values, result.uncertainty.variables[name], strict=True)]  # fmt: skip
    print(f"{name:8s}", "   ".join(told))
assert result.determined

# %%
sysid.plot.transmissibility(result, band=result.uncertainty.transmissibility(freq))

# %% [markdown]
# ## A sensor that reads too much
#
# What is not in the matrices can be an unknown too: here the sensor on floor 3 reads 3 % too much, and its gain is not
# known. The residual is then written out, record less prediction, as complex numbers, and `sysid.real_and_imaginary`
# makes one term of it that counts by the noise of the records. A delay would be a factor `np.exp(-1j * w * tau)`.

# %%
record = test.response[0] * [[1.0], [1.0], [1.03], [1.0]]
gain = sysid.Variable("gain of floor 3", lower=0.8, upper=1.25)
predicted = sysid.FurtherTest(test, mass=M, stiffness=K, damping=C).response
read = (1 + (gain - 1) * np.array([[0.0], [0.0], [1.0], [0.0]])) * predicted
own = sysid.Problem(
    test, mass=M, stiffness=K, damping=C, constraints=[ca.sum1(m) == 332.0],
    misfit=sysid.real_and_imaginary(read - record),
)  # fmt: skip
result = sysid.identify(own, strategy=once, rng=0)
found, std = result.values["gain of floor 3"], result.uncertainty.variables["gain of floor 3"]
print(f"gain of floor 3: {found:.4f} ± {1.96 * std:.4f}")
assert abs(found - 1.03) < 4 * std

# %% [markdown]
# ## The same as a module
#
# In a notebook you try; in a module you keep. `sysid new my_structure` writes a commented module and its test, which
# run at once; `sysid show my_structure.py` prints its unknowns, its scaling and what the data determine before
# anything is searched; `sysid run my_structure.py` identifies it and writes the report. A module is one function:
#
# ```python
# def problem(*, data=None, rng=0):
#     test = ...                      # a sysid.Measurement, from files or simulated
#     k = sysid.Variable(...)
#     return sysid.Problem(test, mass=..., stiffness=..., damping=...)
# ```
#
# ## What else can be written
#
# | what you have | how to write it |
# |---|---|
# | some quantity is known | a number in its place, or `fixed=True` with `guess=` |
# | damping ratios, mode by mode | `damping=sysid.ModalDamping()`, or `(n,)` ratios of your own variables |
# | sensors on some floors only | `recovery=np.eye(4)[[0, 3]]`, in `Problem`, `FurtherTest` and `Structure` alike |
# | the force at the base | `force=` of the measurement: it weighs the structure |
# | magnitudes without phase | `misfit=`: any column of residuals in the place of the usual one |
# | gain, delay, loss factor | `misfit=sysid.real_and_imaginary(prediction - record)`, of complex expressions |
# | something known to some accuracy | `residuals=[sysid.Prior(m[3], 12.0, std=0.2)]` |
# | an order, a limit, a total | `constraints=[k[0] >= k[1], ca.sum1(m) <= 340]` |
# | a finite-element frame | `sysid.frame`, its sections' properties as variables |
# | a form that you need again | a class with four methods: "A matrix model of your own" in the README |
#
# ## Where a search fails
#
# - The result says *No fit*, or that free residues at the poles of the data fit better: the form of the matrices is
#   not that of the structure, or a bound keeps the truth out (the table of unknowns marks what rests on a bound).
# - "Another structure explains the data as well": some forms have several exact answers; a further sensor tells.
# - Give `guess=` where you have one. The search starts there, and from two other points.
