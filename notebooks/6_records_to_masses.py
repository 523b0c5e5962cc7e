# %% [markdown]
# # From records to masses
#
# Two raw records of a four-storey building on a shake table, as a laboratory makes them: cut in motion, of unequal
# length, with noise on every channel, the base and the force included. You will see
#
# 1. how they become a measurement, without a window or a segment to choose;
# 2. the modes, the noise of every channel, and the masses with their intervals, from a measured base force;
# 3. the same without a force, where three floors were weighed;
# 4. what the averaged estimator H1 makes of these records;
# 5. the prediction of a record that was never fitted, line by line and in time.
#
# The records are simulated, so that everything found can be compared with what is true. Notebook 4 shows real records,
# where the structure itself is not quite linear.

# %%
import matplotlib.pyplot as plt
import numpy as np

import sysid

blue, orange, green, red, ink, faint = "#0072B2", "#E69F00", "#009E73", "#D55E00", "#1f2430", "#8a94a0"
plt.rcParams.update({"axes.grid": True, "grid.color": "#e4e8ec", "axes.spines.top": False, "axes.spines.right": False})
plt.rcParams.update({"legend.frameon": False, "font.size": 9})

# %% [markdown]
# ## The building and its records
#
# Four floors on storeys in a chain. The force between table and building is measured below the first storey.

# %%
MASSES = np.array([560.0, 500.0, 460.0, 420.0])  # kg, from the ground
SPRINGS = [1.45e6, 1.05e6, 8.0e5, 5.8e5]  # N/m
RATE = 200.0  # Hz

K = np.zeros((5, 5))
for floor, below in enumerate([4, 0, 1, 2]):  # what each storey stands on; the base comes last
    K[np.ix_([below, floor], [below, floor])] += SPRINGS[floor] * np.array([[1, -1], [-1, 1]])
truth = sysid.Structure(np.diag([*MASSES, 0.0]), K, [0.012, 0.014, 0.017, 0.020], n_base=1)


# %% [markdown]
# Each record is cut out of a longer random motion, so the building is moving at its first and at its last sample. Every
# channel gets white noise of 1 % of its root mean square.


# %%
def record(seconds, strength, rng):
    """Base (1, n), floors (4, n), m/s², and force (1, n), N, with noise; and the noise of each channel."""
    n = round(RATE * seconds)
    period = 2 * round(0.65 * n)  # samples: the motion repeats after 1.3 times the length of the record
    freq = np.arange(1, period // 2) * RATE / period
    base = rng.standard_normal(freq.size) + 1j * rng.standard_normal(freq.size)
    base *= (freq > 0.5) & (freq < 30.0)
    spectra = [base[None], truth.transmissibility(freq)[:, 0] * base, truth.base_force(freq)[:, 0] * base]
    long = [np.fft.irfft(np.pad(spectrum, ((0, 0), (1, 1))), axis=1) for spectrum in spectra]
    scale = strength / np.std(long[0])
    clean = [scale * channels[:, :n] for channels in long]
    noise = [0.01 * np.sqrt(np.mean(channels**2, axis=1)) for channels in clean]
    noisy = [c + std[:, None] * rng.standard_normal(c.shape) for c, std in zip(clean, noise, strict=True)]
    return noisy, noise


rng = np.random.default_rng(1)
first, first_noise = record(80, 1.0, rng)  # s, m/s²
second, second_noise = record(40, 3.0, rng)
unseen, _ = record(30, 2.0, rng)  # for the end of this notebook

figure, panels = plt.subplots(
    2, 2, figsize=(11, 4), sharey="row", sharex="col", width_ratios=[2, 1], layout="constrained"
)
for column, (base, floors, force), name in zip(panels.T, (first, second), ("first run", "second run"), strict=True):
    time = np.arange(base.size) / RATE
    column[0].plot(time, floors[3], color=blue, linewidth=0.5)
    column[1].plot(time, force[0] / 1e3, color=ink, linewidth=0.5)
    column[0].set_title(f"{name}: {base.size / RATE:.0f} s")
    column[1].set_xlabel("time [s]")
panels[0, 0].set_ylabel("roof [m/s²]")
panels[1, 0].set_ylabel("base force [kN]")
plt.show()

# %% [markdown]
# ## From records to a measurement
#
# `from_time` takes each run whole. A Fourier transform of a record that starts and ends in motion is not the response
# to the base alone: the motion at both ends adds a transient, two numbers a mode and run. They are found together with
# the modes, so nothing has to be windowed, averaged or cut to a length. All that is stated is the rate, how the floors
# move with a rigid base, and the band to be fitted.


# %%
def measurement(*runs, force=True, **how):
    """A test of these runs, with the force or without it."""
    given = [(base, floors, loads if force else None) for base, floors, loads in runs]
    sensors = [sysid.Sensor(f"floor {i}", (0.0, 0.0, 3.0 * i), "x") for i in (1, 2, 3, 4)]
    G = np.ones((4, 1))  # each floor follows a rigid base one to one
    return sysid.Measurement.from_time(given, RATE, rigid_body=G, band=(1.0, 20.0), sensors=sensors, **how)


test = measurement(first, second)
print(test)

# %% [markdown]
# ## Masses from the base force
#
# First the mass matrix is left full: nothing is said about the masses.

# %%
full = sysid.identify(
    sysid.Problem(test, mass=sysid.FullMass(), validation=[measurement(unseen)], reference=truth), rng=0
)
print(full.summary())
assert full.determined

# %% [markdown]
# The roof in the second run, with its transients taken off, and what the model answers to the base motion:

# %%
sysid.plot.transmissibility(full, sensor="floor 4", run=1)

# %% [markdown]
# `result.noise` holds the noise that was found with the fit: the standard deviation of a sample of each channel, a row
# a run. Nobody stated it. All intervals come from it.

# %%
print("noise found over true noise")
for i, true in enumerate((first_noise, second_noise)):
    found = [full.noise.base[i], full.noise.response[i], full.noise.force[i]]
    ratios = [f / t for f, t in zip(found, true, strict=True)]
    print(
        f"  run {i + 1}: base {ratios[0][0]:.3f}, floors", *(f"{r:.3f}" for r in ratios[1]), f"force {ratios[2][0]:.3f}"
    )
    assert np.all(np.abs(np.concatenate(ratios) - 1) < 0.15)

# %% [markdown]
# The mass matrix with half of its 95 % intervals, kg. Off its diagonal it is zero within them, which nobody stated:

# %%
M, std = full.structure.mass[:4, :4], full.uncertainty.mass[:4, :4]
for row, stds in zip(M, std, strict=True):
    print("  ".join(f"{value:8.2f} +- {1.96 * s:4.2f}" for value, s in zip(row, stds, strict=True)))
assert np.all(np.abs(M - np.diag(MASSES)) < 4 * std)

# %% [markdown]
# Where it is known that the floors are heavy and the columns light, a lumped mass says so, and the intervals become
# narrower. It has to be true: the records would not contradict a lumped mass that is wrong by itself.

# %%
lumped = sysid.identify(sysid.Problem(test, mass=sysid.LumpedMass()), rng=0)
assert lumped.determined

# %% [markdown]
# ## Three floors weighed, no force
#
# Without a force the records hold no number in kilograms. Here three floors were weighed, and no floor is coupled to
# another or to the table by mass: NaN is what is not known, the mass of the roof.

# %%
known = np.eye(4, 5) * [*MASSES, 1.0]
known[3, 3] = np.nan
weighed = sysid.identify(
    sysid.Problem(measurement(first, second, force=False), mass=sysid.FullMass(known=known)), rng=0
)
low, high = (bound[3, 3] for bound in weighed.uncertainty.interval("mass"))
print(f"roof: {weighed.structure.mass[3, 3]:.2f} kg, 95 % interval {low:.2f} to {high:.2f} kg; true {MASSES[3]:.0f} kg")
assert weighed.determined

# %% [markdown]
# ## The same records through H1
#
# H1 averages the spectra of segments. A window makes each segment fade in and out, and so flattens every peak that is
# not many lines wide. Here the first mode is 2ζf = 0.06 Hz wide; eight lines in it would take segments of 125 s, longer
# than either run. With the frequencies stated (without them the shortest segments show one frequency twice):


# %%
def line(name, one):
    print(f"{name:>7} {one.residual:10.3f} {100 * one.structure.damping_ratios[0]:12.3f} %", end="")
    print(f"{np.trace(one.structure.mass):17.1f} kg {one.determined!s:>12}")


print("segment   residual  damping, mode 1         all floors   determined")
roughly = sysid.SpectralStiffness([2.7, 6.7, 10.1, 12.8])  # Hz
averaged = {}
for seconds in (10, 20, 40):
    h1 = measurement(first, second, estimator="h1", segment=round(seconds * RATE))
    averaged[seconds] = sysid.identify(sysid.Problem(h1, mass=sysid.LumpedMass(), stiffness=roughly), rng=0)
    line(f"{seconds} s", averaged[seconds])
line("whole", lumped)
print(f"   true {'':10} {100 * truth.damping_ratios[0]:12.3f} %{MASSES.sum():17.1f} kg")
assert averaged[10].residual > 0.3 and not averaged[10].determined

# %% [markdown]
# With short segments the damping is wrong, and the fit is none. With the longest ones, four in all, the masses are
# right, but what leakage leaves in the force could hide the mass of the fourth mode, so they are not called determined;
# and their intervals are several times wider than from whole records:

# %%
figure, panels = plt.subplots(1, 4, figsize=(11, 3), sharex=True, sharey=True, layout="constrained")
cases = {"full, force": full, "lumped, force": lumped, "three weighed": weighed, "lumped, H1 of 40 s": averaged[40]}
for i, ax in enumerate(panels):
    for place, (one, colour) in enumerate(zip(cases.values(), (blue, green, orange, red), strict=True)):
        if one is weighed and i < 3:
            continue  # stated, not found
        low, high = (bound[i, i] - MASSES[i] for bound in one.uncertainty.interval("mass"))
        ax.plot([low, high], [place, place], color=colour, linewidth=3, solid_capstyle="butt")
        ax.plot(one.structure.mass[i, i] - MASSES[i], place, "o", color=colour)
    ax.axvline(0, color=ink, linestyle=":")
    ax.set(title=f"floor {i + 1}: {MASSES[i]:.0f} kg", xlabel="found - true [kg]")
panels[0].set_yticks(range(4), cases)
panels[0].invert_yaxis()
plt.show()

# %% [markdown]
# ## A record that was never fitted
#
# The summary above already holds it as "test 1 of 1 never fitted": its residual is as small as that of the fit. It too
# was cut in motion, so its own transients are fitted and taken off before it is judged; nothing else is fitted to it.
#
# In time, `Structure.simulate` follows the recorded base motion. From rest it needs some seconds until the motion
# before the record has died away; `initial_state` finds the state in which the record begins.

# %%
base, floors, force = unseen
model = full.structure
initial = model.initial_state(base, floors, RATE)
from_rest, predicted = model.simulate(base, RATE), model.simulate(base, RATE, initial=initial)
predicted_force = model.simulate_force(base, RATE, initial=initial)

print("error of the floors relative to the base")
for name, one in (("from rest", from_rest), ("from the state found", predicted)):
    scores = sysid.time_scores(floors - base, one - base)
    print(f"  {name:22}", *(f"{100 * error:6.2f} %" for error in scores.error))
assert np.all(scores.error < 0.05)
scores = sysid.time_scores(force, predicted_force)
print(f"base force: error {100 * scores.error[0]:.2f} %", end=", ")
print(f"largest {scores.measured_peaks[0]:.0f} N measured, {scores.predicted_peaks[0]:.0f} N predicted")

# %%
time = np.arange(base.size) / RATE
shown = time < 8
figure, ax = plt.subplots(figsize=(11, 3.2), layout="constrained")
ax.plot(time[shown], (floors - base)[3, shown], color=faint, linewidth=3, label="measured")
ax.plot(time[shown], (from_rest - base)[3, shown], color=orange, linewidth=1, label="from rest")
ax.plot(time[shown], (predicted - base)[3, shown], color=red, linewidth=1, linestyle="--", label="from the state found")
ax.set(xlabel="time [s]", ylabel="roof, relative [m/s²]")
ax.legend(loc="upper right", ncols=3)
plt.show()
