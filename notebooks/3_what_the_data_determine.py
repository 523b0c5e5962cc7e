# %% [markdown]
# # What the data determine
#
# A good fit does not mean that mass and stiffness are known. You will see
#
# 1. two structures that answer a base shake *identically*, although their mass and stiffness matrices differ by more
#    than 100 %;
# 2. what all such structures have in common, and how few numbers tell them apart;
# 3. which knowledge closes the question: a total mass, weighed floors, a lumped mass, a measured base force;
# 4. the difference between an *interval* (what the data leave open) and an *uncertainty* (what noise does);
# 5. a mode that the base does not move;
# 6. damping that couples the modes, which only weighed modes show whole.
#
# Every example has two degrees of freedom, so that it fits into a picture. Nothing here depends on sysid's way of
# computing: it holds for every method that uses the same records.

# %%
import matplotlib.pyplot as plt
import numpy as np

import sysid

blue, orange, green, pink, red = "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00"  # for any colour vision
ink, faint = "#1f2430", "#8a94a0"
plt.rcParams.update({"axes.grid": True, "grid.color": "#e4e8ec", "axes.spines.top": False, "axes.spines.right": False})
plt.rcParams.update({"legend.frameon": False, "font.size": 9})

# %% [markdown]
# ## Two structures, one response
#
# A frame with two floors of 350 and 150 kg on a shake table, storeys of 600 and 150 kN/m. Its modes, on a fixed base:

# %%
MASSES, SPRINGS = np.array([350.0, 150.0]), np.array([6e5, 1.5e5])  # kg, N/m
k1, k2 = SPRINGS
frame = sysid.Structure(
    np.diag([*MASSES, 0.0]),  # two floors, then the base, which has no mass of its own
    [[k1 + k2, -k2, -k1], [-k2, k2, 0], [-k1, 0, k1]],
    damping_ratios=[0.010, 0.015],
    n_base=1,
)
total = frame.rigid_body_mass[0, 0]
print("natural frequencies:", frame.natural_frequencies.round(3), "Hz")
print("effective masses:", frame.effective_masses[:, 0, 0].round(1), f"kg of {total:.0f} kg")

# %% [markdown]
# Relative to the base, a mode answers with its shape times its participation. If a mode's shape is divided by √t and
# its participation multiplied by √t, the product stays, and so does the response. This holds for each mode by itself,
# with any positive number t. With P the inverse of the mode shapes, Γ the participations and G the rigid-body motion,
# the matrices that belong to the numbers t are
#
# $$M_{SS} = P^T \mathrm{diag}(t) P \qquad K_{SS} = P^T \mathrm{diag}(t\,\omega^2) P
# \qquad M_{S0} = P^T \mathrm{diag}(t) (\Gamma - P G)$$
#
# The numbers t are the *modal masses* in units of the true ones. Let mode 1 weigh 0.4 of its true mass and mode 2 2.4
# times. What the effective masses then leave of 500 kg is given to the base, so that even the total mass is the same.

# %%
P, G, participation = np.linalg.inv(frame.mode_shapes), frame.rigid_body, frame.participation
omega = 2 * np.pi * frame.natural_frequencies  # rad/s


def member(t):
    """The structure with modal masses `t`, (2,), that answers as the frame does and has its total mass."""
    t = np.asarray(t)
    beyond = participation - P @ G
    M, K = P.T @ np.diag(t) @ P, P.T @ np.diag(t * omega**2) @ P
    coupling = P.T @ np.diag(t) @ beyond
    base = beyond.T @ np.diag(t) @ beyond + total - t @ participation**2
    return sysid.Structure(
        np.block([[M, coupling], [coupling.T, base]]),
        np.block([[K, -K @ G], [-(K @ G).T, G.T @ K @ G]]),
        frame.damping_ratios,
        n_base=1,
    )


t = np.array([0.4, 2.4])
other = member(t)
freq = np.linspace(1, 10, 300)
answers = [structure.transmissibility(freq) for structure in (frame, other)]
difference = np.abs(answers[1] - answers[0]).max() / np.abs(answers[0]).max()
in_mass, in_stiffness = (
    np.linalg.norm(b[:2, :2] - a[:2, :2]) / np.linalg.norm(a[:2, :2])
    for a, b in ((frame.mass, other.mass), (frame.stiffness, other.stiffness))
)
print(f"responses differ by {difference:.1e}, M_SS by {100 * in_mass:.0f} %, K_SS by {100 * in_stiffness:.0f} %")
print(f"rigid-body mass: {frame.rigid_body_mass[0, 0]:.1f} kg and {other.rigid_body_mass[0, 0]:.1f} kg")
assert difference < 1e-12 and in_mass > 1 and in_stiffness > 1  # more than 100 %

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.4), layout="constrained")
for structure, look in ((frame, {"color": ink}), (other, {"color": red, "linestyle": "--"})):
    name = "frame" if structure is frame else "other member"
    left.semilogy(freq, np.abs(structure.transmissibility(freq)[1, 0]), label=name, **look)
    right.semilogy(freq, np.abs(structure.base_force(freq)[0, 0]), label=name, **look)
left.set(title="top floor, absolute acceleration per unit base acceleration", ylabel="[–]")
right.set(title="force between table and structure per unit acceleration", ylabel="[kg]")
for ax in (left, right):
    ax.set_xlabel("frequency [Hz]")
    ax.legend()
plt.show()

# %%
figure, panels = plt.subplots(1, 4, figsize=(10, 2.8), layout="constrained")
for ax, (title, matrix) in zip(
    panels,
    {
        "frame: $M_{SS}$ [kg]": frame.mass,
        "other member: $M_{SS}$ [kg]": other.mass,
        "frame: $K_{SS}$ [kN/m]": frame.stiffness / 1e3,
        "other member: $K_{SS}$ [kN/m]": other.stiffness / 1e3,
    }.items(),
    strict=True,
):
    block = matrix[:2, :2]
    ax.imshow(block / np.abs(block).max(), cmap="RdBu_r", vmin=-1.6, vmax=1.6)
    for (i, j), value in np.ndenumerate(block):
        ax.text(j, i, f"{value:.0f}", ha="center", va="center", fontsize=13)
    ax.set(title=title, xticks=[0, 1], yticks=[0, 1], xticklabels=["floor 1", "floor 2"])
    ax.set_yticklabels(["floor 1", "floor 2"], rotation=90, va="center")
    ax.grid(False)
plt.show()

# %% [markdown]
# No accelerometer, however good, and no number of repeated tests tells these two apart. Only the force between table
# and structure does: it weighs each mode (right-hand picture above).
#
# ## The cone of all models
#
# All structures that explain the accelerations are given by t: two positive numbers here, n for n modes. Drawn by the
# effective masses that they give to the modes, they fill a quadrant, a *cone*: with every model, all its multiples
# belong to it. Each further piece of knowledge cuts it:
#
# - the **total mass** bounds it: effective masses cannot sum to more than what there is. A triangle is left, since
#   the base and whatever moves with it may have any part of the total;
# - a **lumped (diagonal) mass** leaves one line from the origin: ratios are known, the scale is not;
# - a **weighed floor** (a known diagonal entry of M) leaves a line segment; a second one closes it where the lines
#   cross;
# - a **base force** gives the point itself, as sharp as its noise allows.

# %%
true = frame.effective_masses[:, 0, 0]  # kg, of modes 1 and 2
axis = np.array([0.0, 520.0])


def line(weights, value):
    """Effective mass of mode 2 on the line where ``weights @ t = value``, for that of mode 1 on `axis`."""
    a, b = weights / true  # modal masses are effective masses over the true ones
    return (value - a * axis) / b


figure, ax = plt.subplots(figsize=(8.4, 4.8), layout="constrained")
ax.fill_between(axis, 0, axis[1], color="#eef2f6", label="explain the accelerations: every point")
ax.fill_between([0, total], 0, [total, 0], color=blue, alpha=0.16, linewidth=0, label="with the total mass, 500 kg")
ax.plot(axis, axis * true[1] / true[0], color=orange, linewidth=2, label="with a lumped mass")
ax.plot(axis, line(P[:, 0] ** 2, MASSES[0]), color=green, linewidth=2, label="with floor 1 weighed, 350 kg")
ax.plot(axis, line(P[:, 1] ** 2, MASSES[1]), color=pink, linewidth=2, label="with floor 2 weighed, 150 kg")
ax.plot(*true, "o", color=ink, markersize=8, zorder=5, label="the frame: with a measured force")
ax.plot(*(t * true), "D", color=red, markersize=7, zorder=5, label="the other member")
ax.set(xlim=axis, ylim=axis, aspect="equal")
ax.set(xlabel="effective mass of mode 1 [kg]", ylabel="effective mass of mode 2 [kg]")
figure.legend(loc="outside right center")
plt.show()
assert np.isclose(P[:, 0] @ P[:, 1], 0, atol=1e-9)  # M_12 = t1 P11 P12 + t2 P21 P22 vanishes where t1 = t2

# %% [markdown]
# A line is right only where what it assumes is right. Had the other member stood on the table, the records would be
# the same, `LumpedMass` would return the frame, and nothing in the data would object.
#
# ## What each piece of knowledge closes
#
# The same records, 1 % noise, with different knowledge. `mass_interval` and `stiffness_interval` are the least and
# the largest value of each entry over *all* models that explain the records and keep to what was stated; noise is
# left aside. `uncertainty` is what noise does, and NaN where the entry is open.

# %%
nan = np.nan
cases = {
    "accelerations alone": sysid.FullMass(),
    "total mass, 500 kg": sysid.FullMass(total, healing="rigid_body"),
    "lumped mass": sysid.LumpedMass(),
    "floor 1 weighed": sysid.FullMass(known=[[MASSES[0], nan], [nan, nan]]),
    "both floors weighed": sysid.FullMass(known=[[MASSES[0], nan], [nan, MASSES[1]]]),
    "lumped mass, total 500 kg": sysid.LumpedMass(total),
    "base force measured": sysid.FullMass(),
}
results = {}
for name, mass in cases.items():
    test = sysid.simulate(frame, freq, noise=0.01, force=name.startswith("base force"), rng=0)
    results[name] = sysid.identify(sysid.Problem(test, mass=mass), rng=0)

print("residual    upper storey stiffness K_22, kN/m: interval over all models, and 95 % noise")
for name, result in results.items():
    low, high = (result.stiffness_interval[:, 1, 1] / 1e3).round(2) + 0.0
    half = 1.96 * result.uncertainty.stiffness[1, 1] / 1e3
    word = "determined" if result.determined else "open"
    print(f"{result.residual:.4f}  {name:26} {low:7.2f} to {high:7.2f}   +- {half:5.2f}   {word}")
    assert abs(result.residual - 0.01) < 0.001
    assert not result.determined or abs(low - SPRINGS[1] / 1e3) < 1.5 * half

# %%
figure, (wide, close) = plt.subplots(1, 2, figsize=(10.5, 3.6), sharey=True, layout="constrained")
end = 550.0
for ax in (wide, close):
    ax.axvline(SPRINGS[1] / 1e3, color=red, linewidth=1, linestyle="--", label="true")
for row, result in enumerate(results.values()):
    low, high = result.stiffness_interval[:, 1, 1] / 1e3
    half = 1.96 * result.uncertainty.stiffness[1, 1] / 1e3
    if not result.determined:
        wide.plot([low, min(high, end)], [row, row], color=blue, alpha=0.45, linewidth=7, solid_capstyle="butt")
        if high > end:
            wide.plot(end, row, ">", color=blue, markersize=11, clip_on=False)
        close.text(150, row, "open", ha="center", va="center", color=faint, backgroundcolor="white")
    else:
        wide.plot(low, row, "o", color=ink)
        close.errorbar(low, row, xerr=half, fmt="o", color=ink, capsize=3)
wide.set(title="interval: over all models (arrow: unbounded)", xlim=(0, end), xlabel="$K_{22}$ [kN/m]")
close.set(title="uncertainty: 95 %, from 1 % noise", xlim=(148.5, 151.5), xlabel="$K_{22}$ [kN/m]")
wide.set_yticks(range(len(results)), list(results))
wide.invert_yaxis()
plt.show()

# %% [markdown]
# All residuals are the noise, 1 %: the fit cannot tell. Four of the seven cases are open, the one with the right
# total mass among them. The other three find the true 150 kN/m (dashed) within their noise.
#
# What the accelerations *do* determine, in every case, is whatever is the same all over the cone: frequencies,
# damping ratios, transmissibilities, and M⁻¹K (its second row is -k₂/m₂ and k₂/m₂, here 1000 1/s²).

# %%
for name, result in results.items():
    M, K = result.structure.mass[:2, :2], result.structure.stiffness[:2, :2]
    ratio = np.linalg.solve(M, K)
    print(f"{name:26} f = {result.structure.natural_frequencies.round(4)} Hz, M⁻¹K row 2 = {ratio[1].round(1)} 1/s²")
    assert np.allclose(ratio[1], [-1000, 1000], rtol=0.02)
closed = ["both floors weighed", "lumped mass, total 500 kg", "base force measured"]
assert [name for name, result in results.items() if result.determined] == closed

# %% [markdown]
# The result says this in words. Take its sentences seriously before the matrices:

# %%
print(*results["total mass, 500 kg"].undetermined, sep="\n")
print(*results["base force measured"].closed_by, sep="\n")

# %% [markdown]
# ## A mode that the base does not move
#
# Two equal posts of 10 kg side by side on the table, joined by a soft spring. They sway together in mode 1. In mode 2
# they sway against each other: the base cannot start that motion, and does not feel it. Nothing measured in a base
# shake shows it, force included. An offset of their masses by a percent or so makes it appear.


# %%
def posts(offset):
    """Two posts, the first heavier and the second lighter by the fraction `offset`."""
    root, joint = 1e5, 2e4  # N/m
    stiffness = [[root + joint, -joint, -root], [-joint, root + joint, -root], [-root, -root, 2 * root]]
    return sysid.Structure(np.diag([10 * (1 + offset), 10 * (1 - offset), 0]), stiffness, [0.01, 0.01], n_base=1)


lines = np.linspace(10, 25, 250)
figure, panels = plt.subplots(1, 2, figsize=(10, 3.4), sharey=True, layout="constrained")
for ax, offset in zip(panels, (0.0, 0.01), strict=True):
    test = sysid.simulate(posts(offset), lines, noise=0.01, force=True, rng=0)
    for i, colour in enumerate((blue, orange)):
        ax.semilogy(lines, np.abs(test.response[0, i]), color=colour, linewidth=1, label=f"post {i + 1}")
    hidden = posts(offset).natural_frequencies[1]
    ax.axvline(hidden, color=faint, linestyle=":")
    ax.text(hidden + 0.15, 40, f"mode 2,\n{hidden:.1f} Hz", color=faint, va="top")
    ax.set(title=f"masses off by {100 * offset:.0f} %", xlabel="frequency [Hz]")
    ax.legend(loc="lower left")
panels[0].set_ylabel("transmissibility [–]")
plt.show()

# %% [markdown]
# With equal posts sysid finds one mode, and says that the two sensors record one motion. It does not invent the
# second. With 1 % offset the *accelerations* show mode 2, and its frequency and damping are found. But the *force*
# hardly changes: mode 2 moves less than a thousandth of the mass, and is not weighed.

# %%
for offset in (0.0, 0.01):
    test = sysid.simulate(posts(offset), lines, noise=0.01, force=True, rng=0)
    result = sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0)
    print(f"masses off by {100 * offset:.0f} %: modes found at {result.structure.natural_frequencies.round(2)} Hz")
    print(*("  - " + sentence for sentence in result.undetermined), sep="\n")

# %% [markdown]
# How much must a mode weigh? Eight tests with different noise for each of several offsets, from 1 to 20 %. Each dot
# is the error in the mass of post 1 that one test finds; the line is what `result.uncertainty` predicts (the mean
# over the tests).

# %%
offsets = [0.01, 0.02, 0.05, 0.2]
share, errors, spread, verdicts = [], [], [], []
for offset in offsets:
    truth = posts(offset)
    tests = [sysid.simulate(truth, lines, noise=0.01, force=True, rng=seed) for seed in range(8)]
    found = [sysid.identify(sysid.Problem(test, mass=sysid.FullMass()), rng=0) for test in tests]
    share.append(truth.effective_mass_percent[1, 0])
    errors.append([100 * (result.structure.mass[0, 0] / truth.mass[0, 0] - 1) for result in found])
    spread.append(np.mean([100 * result.uncertainty.mass[0, 0] / truth.mass[0, 0] for result in found]))
    verdicts.append(sum(result.determined for result in found))
    print(
        f"offset {100 * offset:3.0f} %: effective mass of mode 2 {share[-1]:6.3f} %, standard deviation of M_11 "
        f"{spread[-1]:6.2f} % predicted, {np.std(errors[-1]):6.2f} % found; determined in {verdicts[-1]} of 8"
    )
assert verdicts[0] == 0 and verdicts[-1] == 8

# %%
figure, ax = plt.subplots(figsize=(7, 3.8), layout="constrained")
ax.loglog(share, 1.96 * np.array(spread), color=red, label="95 % of the errors lie below, predicted")
for percent, values in zip(share, errors, strict=True):
    ax.plot(np.full(len(values), percent), np.abs(values), "o", color=blue, markersize=4, alpha=0.7)
ax.plot([], [], "o", color=blue, markersize=4, label="one test")
ax.set(xlabel="effective mass of mode 2 [% of total]", ylabel="error of $M_{11}$, without its sign [%]")
ax.set(title="1 % noise on all records", ylim=(1e-3, 100))
ax.legend(loc="lower left")
plt.show()

# %% [markdown]
# The error grows about as one over the effective mass: a mode is weighed as well as the force in its band is
# measured, and not better. If a weak mode matters, shake in another direction, or excite it by other means. These
# intervals are first-order ones: for a mode that the result calls "not weighed" read its sentence, not its interval.
#
# ## Damping that couples modes
#
# A dashpot between the two floors of the first frame takes energy out of both modes at once: $\Phi^T C \Phi$ is no
# longer diagonal, and no damping ratios hold it. With the base force C is found whole beside M and K, with the standard
# deviation of each entry.

# %%
apart = np.array([1.0, -1.0])  # what the dashpot sees of the floors
C = frame.damping + 500.0 * np.outer(apart, apart)  # N s/m
damped = sysid.Structure(frame.mass, frame.stiffness, damping_matrix=C, n_base=1)
lines = np.linspace(2.0, 14.0, 400)
test = sysid.simulate(damped, lines, noise=0.01, force=True, rng=0)
weighed = sysid.identify(sysid.Problem(test), rng=0)
print(f"with the force: {weighed.judgement}; C, its standard deviations, and the true one, N s/m:")
print(np.hstack([weighed.structure.damping, weighed.uncertainty.damping, C]).round(1))
(told,) = (one for one in weighed.findings if one.kind == "damping")
print(f"dampers couple the modes by {told.numbers['share']:.1%} of the response")
assert weighed.determined

# %% [markdown]
# From accelerations alone the scale of each mode is open, and what couples two modes depends on the scale of both. The
# fit has damping ratios only. It says so, and what they miss:

# %%
alone = sysid.identify(sysid.Problem(sysid.simulate(damped, lines, noise=0.01, rng=0)), rng=0)
print(f"without the force: {alone.judgement}", *alone.undetermined, sep="\n  - ")
assert not alone.success

# %% [markdown]
# ## In short
#
# Damping is meant as ratios. C of dampers that couple modes is known where the base force is recorded.
#
# | you have | frequencies, damping, transmissibility | M and K |
# |---|---|---|
# | accelerations | yes | one model of many, in units of 1 kg |
# | and the total mass | yes | one of many; bounded |
# | and n independent known masses | yes | yes |
# | and a mass that *is* lumped, with its total | yes | yes |
# | and the base force | yes | yes, for the modes that the base moves |
