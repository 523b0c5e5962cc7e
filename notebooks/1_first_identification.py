# %% [markdown]
# # First identification
#
# From a base-shake test to mass, stiffness and damping matrices. You will see
#
# 1. what sysid needs from a test: four arrays;
# 2. how to state the problem and identify;
# 3. what to look at before you believe the result;
# 4. how to take the model home: a file, a state space, a Craig-Bampton form.
#
# The structure is simulated, so that every answer can be held against the truth. Your own test enters at the cell
# "The test": replace its four arrays, and the rest stays as it is.

# %%
import matplotlib.pyplot as plt
import numpy as np
import scipy.linalg
import scipy.signal

import sysid
from sysid.frame import Beam, Frame, PointMass, Section

colours = ["#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00"]  # told apart with any colour vision
plt.rcParams.update({"axes.prop_cycle": plt.cycler(color=colours), "axes.grid": True, "grid.color": "#e4e8ec"})
plt.rcParams.update({"axes.spines.top": False, "axes.spines.right": False, "legend.frameon": False, "font.size": 9})

# %% [markdown]
# ## The structure
#
# A mast of aluminium tube on the shaker carries three boxes, and an arm with two more. Five accelerometers: along x
# at three heights of the mast, along z at the middle and at the tip of the arm. The table moves along x, then along
# z. Shaking along one axis moves the sensors of the other too, because the arm hangs off to one side.

# %%
names = ["mast low", "mast mid", "mast top", "arm mid", "arm tip"]
positions = [(0, 0, 0.3), (0, 0, 0.6), (0, 0, 0.9), (0.25, 0, 0.9), (0.5, 0, 0.9)]  # m
axes = ["x", "x", "x", "z", "z"]


def tube(radius, wall):
    inertia = np.pi * radius**3 * wall
    return Section(E=70e9, G=26e9, A=2 * np.pi * radius * wall, Iy=inertia, Iz=inertia, J=2 * inertia, density=2700.0)


nodes = [(0, 0, 0), *positions]
beams = [Beam(i, i + 1, tube(0.04, 0.003) if i < 3 else tube(0.03, 0.002), (0, 1, 0)) for i in range(5)]
boxes = [PointMass(node, kg) for node, kg in zip(range(1, 6), [4.0, 3.0, 2.0, 1.0, 1.5], strict=True)]
truth = Frame(nodes, beams, boxes).structure(
    list(zip(range(1, 6), axes, strict=True)),
    damping_ratios=[0.010, 0.012, 0.015, 0.015, 0.020],
    base_nodes=0,
    base_axes="xz",
)
truth

# %% [markdown]
# ## The test
#
# This is all that sysid needs. With `n` sensors and `d` directions of the base:
#
# | array | shape | what it is |
# |---|---|---|
# | `freq` | (lines,) | Hz |
# | `frf` | (n, d, lines) | *absolute* acceleration of each sensor per unit base acceleration, complex, e^(+iωt) |
# | `G` | (n, d) | motion of each sensor when structure and base move as one rigid body: geometry |
# | `force` | (d, d, lines) | force between table and structure per unit base acceleration, kg; optional |
#
# Both records carry 1 % noise (of their root mean square, which the peaks rule).

# %%
freq = np.geomspace(5, 900, 1000)
virtual = sysid.simulate(truth, freq, noise=0.01, force=True, rng=1, base_axes="xz")
frf, force = (np.moveaxis(record, 0, 1) for record in (virtual.response, virtual.force))  # the run is the direction

G = sysid.rigid_body(positions, axes, base_axes="xz")
sensors = [sysid.Sensor(*described) for described in zip(names, positions, axes, strict=True)]
test = sysid.Measurement.from_frf(freq, frf, rigid_body=G, force=force, sensors=sensors, base_axes="xz")
test

# %% [markdown]
# Look at the records before anything is fitted. Far below the first resonance little amplifies, so within some
# percent every sensor must follow the base as `G` says, and the force must be the mass of the structure times the
# acceleration. A swapped axis, a wrong sign or a wrong calibration shows here, for free.

# %%
low = freq < 8
print("G of the geometry | mean of the FRFs below 8 Hz")
for name, row, measured in zip(names, G, frf[:, :, low].real.mean(axis=-1), strict=True):
    print(f"  {name:9}{row[0]:6.0f}{row[1]:4.0f}  |{measured[0]:7.2f}{measured[1]:7.2f}")
weighed = np.diag(force[:, :, low].real.mean(axis=-1))
print(f"force below 8 Hz: {weighed[0]:.1f} kg in x, {weighed[1]:.1f} kg in z; mass of the structure", end=" ")
print(f"{truth.rigid_body_mass[0, 0]:.1f} kg")
assert np.allclose(frf[:, :, low].real.mean(axis=-1), G, atol=0.1)

# %%
figure, panels = plt.subplots(1, 3, figsize=(11, 3.6), sharex=True, layout="constrained")
for ax, j, axis in zip(panels[:2], range(2), "xz", strict=True):
    ax.loglog(freq, np.abs(frf[:, j]).T, linewidth=0.9, label=names)
    ax.set(title=f"transmissibility, base along {axis} [–]", ylim=(2e-3, 200))
figure.legend(handles=panels[0].lines, loc="outside lower center", ncols=5)
for j, axis in enumerate("xz"):
    panels[2].loglog(freq, np.abs(force[j, j]), linewidth=0.9, label=f"along {axis}")
panels[2].set(title="base force per unit acceleration [kg]")
panels[2].legend()
for ax in panels:
    ax.set_xlabel("frequency [Hz]")
plt.show()

# %% [markdown]
# How many modes are in there? The stabilisation diagram is a first look, before any model is chosen: a column of
# poles that stay where they are as the order of the model rises is a mode. sysid finds the modes itself (dashed
# lines); the diagram is a second opinion by another method.

# %%
sysid.plot.stabilisation(test)

# %% [markdown]
# ## Problem and identification
#
# A problem is the measurement and what is assumed of each matrix. Here nothing is assumed: a full mass matrix, a
# stiffness known by its spectrum, whose frequencies are found in the data, and modal damping (those two need not be
# written). No starting values, no bounds.

# %%
problem = sysid.Problem(test, mass=sysid.FullMass())
result = sysid.identify(problem, rng=0)
print(result.summary())

# %% [markdown]
# ## What to look at
#
# **The residual** is what the fit leaves of the accelerations relative to the base, as a fraction. It should be your
# noise, neither more (the model misses something) nor much less (it follows the noise). Here the noise is 1 % by
# construction.
#
# **"Determined"** is the most important line. It says that data and assumptions leave one mass and one stiffness
# matrix, and why: here because the force was measured. Without force the same fit would be just as good, and the
# matrices one pair of many; notebook 3 is about that.
#
# **The mode table** gives each frequency, damping ratio and effective mass with half of its 95 % interval.

# %%
assert result.success and result.determined
floor = test.residual(truth)  # what the true structure leaves of these noisy records
print(f"residual {result.residual:.4f}, the true structure leaves {floor:.4f}")

# %% [markdown]
# **The responses**, with the identified one dashed over the measured one and their difference below: the difference
# should look like noise, without peaks at the modes. The band is the 95 % interval of the *identified curve*; in a
# good test it is too narrow to be seen on a logarithmic axis, so the panel on the right shows the standard deviation.
# The noise of a single line is 3 % of the base acceleration and hides the response where that is small; the curve, in
# which 1000 lines share 5 modes, is known far better.

# %%
spread = result.uncertainty.transmissibility(freq)  # standard deviation, (n_sensors, d, lines)
i, j = names.index("arm mid"), "xz".index("x")
size = np.abs(result.structure.transmissibility(freq)[i, j])
noise = np.sqrt(np.mean(np.abs(test.relative - result.predict(test)) ** 2))

figure, (left, right) = plt.subplots(1, 2, figsize=(11, 3.6), layout="constrained")
sysid.plot.transmissibility(result, left, sensor="arm mid", run="x", band=spread)
left.set_ylim(2e-4, 60)
left.legend(loc="lower right", ncols=4, fontsize=8)
right.loglog(freq, 100 * noise / size, color="#1f2430", label="one measured line")
right.loglog(freq, 100 * spread[i, j] / size, color=colours[4], label="identified curve")
right.set(xlabel="frequency [Hz]", ylabel="[% of the response]", title="standard deviation")
right.legend()
plt.show()
assert 0.02 < noise < 0.04

# %% [markdown]
# **The base force** is what weighs the modes: look at it too.

# %%
sysid.plot.base_force(result, direction="x", band=result.uncertainty.base_force(freq))

# %% [markdown]
# **Mode shapes**, in space. Only directions that carry a sensor move in these pictures: the mast along x, the arm
# along z.

# %%
sysid.plot.mode_shapes(result)

# %% [markdown]
# **Effective masses** say how much of the structure each mode takes along, in each direction of the base. Their sum
# stays below 100 %: the rest moves with the base in this band. Along z that is most of the structure here, because
# the mast hardly gives way along its own axis.

# %%
sysid.plot.effective_masses(result)

# %%
sums = result.structure.effective_mass_percent.sum(axis=0)
print(f"sum of effective masses: {sums[0]:.1f} % along x, {sums[1]:.1f} % along z")
assert sums[1] < 50

# %% [markdown]
# **The matrices.** In a real test there is no truth to compare with, only the 95 % intervals of each entry. Here
# there is, so the intervals can be judged too: each dot is the error of one entry, each bar its 95 % interval, both
# in percent of the root of the two diagonal entries. A bar should hold the zero line 19 times in 20 on average; in
# one test entries share their noise, so that a few often miss it together.

# %%
n = result.structure.n
rows, columns = np.tril_indices(n)
pairs = {
    "$M_{SS}$": (result.structure.mass, truth.mass, result.uncertainty.mass),
    "$K_{SS}$": (result.structure.stiffness, truth.stiffness, result.uncertainty.stiffness),
    "$C$": (result.structure.damping, truth.damping, result.uncertainty.damping),
}
figure, panels = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
for ax, (title, (found, true, std)) in zip(panels, pairs.items(), strict=True):
    size = np.sqrt(np.outer(np.diag(true)[:n], np.diag(true)[:n]))
    error, width = (100 * (part / size)[rows, columns] for part in ((found - true)[:n, :n], 1.96 * std))
    ax.axhline(0, color="#3c4450", linewidth=0.8)
    ax.errorbar(range(rows.size), error, width, fmt="o", markersize=3.5, elinewidth=1.2, color=colours[0])
    ax.set_xticks(range(rows.size), [f"{i + 1},{j + 1}" for i, j in zip(rows, columns, strict=True)], rotation=90)
    ax.set(title=title, xlabel="entry")
    held, worst = np.count_nonzero(np.abs(error) <= width), np.abs(error).max()
    print(f"{title.strip('$'):7} largest error {worst:.2g} %, {held} of {rows.size} intervals hold the truth")
panels[0].set_ylabel("error and 95 % interval [%]")
plt.show()

# %% [markdown]
# ## The model taken home
#
# **A file** (HDF5) keeps the measurement, the problem, the result and how it was found.

# %%
result.save("bracket.h5")
again = sysid.load("bracket.h5")
assert np.array_equal(again.structure.mass, result.structure.mass)
again

# %% [markdown]
# **A state space**, from base accelerations to absolute accelerations of the sensors, goes into any simulation in
# time. Here a half-sine shock of the base along x, 10 g for 11 ms, which this test never applied.

# %%
time = np.arange(0, 0.25, 1e-4)  # s
shock = np.where(time < 0.011, 10 * np.sin(np.pi * time / 0.011), 0.0)  # g
base = np.column_stack([shock, np.zeros_like(shock)])  # along x, z
_, identified, _ = scipy.signal.lsim(result.structure.to_state_space(), base, time)
_, true, _ = scipy.signal.lsim(truth.to_state_space(), base, time)

tip = names.index("arm tip")
figure, ax = plt.subplots(figsize=(8, 3.2), layout="constrained")
ax.plot(1e3 * time, shock, color="#8a94a0", linewidth=1, label="base, x")
ax.plot(1e3 * time, true[:, tip], color="#1f2430", linewidth=1, label="arm tip, z: true structure")
ax.plot(1e3 * time, identified[:, tip], color=colours[4], linestyle="--", label="arm tip, z: identified")
ax.set(xlabel="time [ms]", ylabel="acceleration [g]", title="half-sine shock, 10 g, 11 ms", ylim=(-32, 36))
ax.legend(loc="upper right", ncols=3)
plt.show()
print(f"peak at the arm tip {np.abs(identified[:, tip]).max():.2f} g, true {np.abs(true[:, tip]).max():.2f} g")

# %% [markdown]
# **The Craig-Bampton form**: modal coordinates beside the base's own motion, the form in which launcher and
# spacecraft models are exchanged. Its base degrees of freedom couple to whatever the structure will stand on. For
# example a 20 kg plate on springs, free to slide along x and z, in place of the shaker:

# %%
cb = result.structure.to_craig_bampton()  # mass, stiffness, damping (n + d, n + d); recovery (n_sensors, n + d)
plate = np.zeros_like(cb.mass)
plate[n:, n:] = 20.0 * np.eye(2)  # kg
springs = np.zeros_like(cb.stiffness)
springs[n:, n:] = np.diag([2e6, 8e6])  # N/m, along x and z


def on_plate(form):
    """Natural frequencies, Hz."""
    return np.sqrt(scipy.linalg.eigvalsh(form.stiffness + springs, form.mass + plate)) / (2 * np.pi)


print("on the shaker, Hz:", *(f"{f:8.3f}" for f in result.structure.natural_frequencies))
print("on the plate, Hz: ", *(f"{f:8.3f}" for f in on_plate(cb)))
print("  true structure: ", *(f"{f:8.3f}" for f in on_plate(truth.to_craig_bampton())))

# %% [markdown]
# ## Where to go from here
#
# - No force was measured, or the summary says "not determined": notebook 3.
# - Time records in place of FRFs, several events, real noise: notebook 4.
# - You know how the structure is built (springs between floors, known masses): notebook 2.
