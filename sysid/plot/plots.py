"""The pictures of `sysid.plot`.

What takes `ax` draws into the axes that it is given and returns them; without, it returns a new figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from sysid.errors import InputError, refuse
from sysid.measurement.measurement import Measurement
from sysid.modal_analysis.outliers import HUBER
from sysid.modal_analysis.stretches import stretches_of
from sysid.plot.canvas import (
    COLOURS,
    FAINT,
    INK,
    colour_bar,
    count_cells,
    count_modes,
    dress,
    new_axes,
    new_figure,
    plain_log,
    positive,
)  # fmt: skip
from sysid.plot.panels import (
    draw,
    draw_cmif,
    draw_law,
    draw_stabilisation,
    force_channel,
    key,
    label_once,
    legend_below,
    named_index,
    panels,
    place,
    response_channel,
    run_index,
    strongest,
    with_force,
)  # fmt: skip
from sysid.results.identification import Identification
from sysid.results.tables import counted
from sysid.structure.sensor import axis_vector
from sysid.structure.structure import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def transmissibility(
    identification: Identification,
    ax: Axes | Sequence[Axes] | None = None,
    *,
    sensor: int | str | None = None,
    run: int | str | None = None,
    measurement: Measurement | None = None,
    band: ArrayLike | None = None,
) -> Any:
    """Measured against identified absolute response of one sensor, magnitude and phase.

    For unit runs (FRFs, simulated tests) this is the absolute transmissibility from one base
    direction. For other runs, in which the whole base moves as it did, it is the spectrum of the
    sensor's absolute acceleration, and the phase is against the base direction that moved most.

    Parameters
    ----------
    identification : Identification
    ax : Axes or two Axes, optional
        Magnitude alone, or magnitude and phase; a new figure with both where None.
    sensor : int or str, optional
        Index or name; with `run`, the channel with the largest relative acceleration by default.
    run : int or str, optional
        Index, from 0, or name: of unit runs the base direction's, such as "x", else such as "run 2", the second.
    measurement : Measurement, optional
        Another test of the same sensors to predict, such as a validation; the one fitted by default.
    band : array_like, shape (n_sensors, d, n_freq), optional
        Standard deviation of the transmissibility at the test's lines, such as `Uncertainty.transmissibility` gives:
        the 95 % interval of the magnitude is shaded where it is wide enough to be seen.

    Returns
    -------
    Figure, Axes or the sequence given

    Examples
    --------
    >>> import numpy as np
    >>> import sysid
    >>> result = sysid.load("results/cantilever_tower")  # doctest: +SKIP
    >>> band = result.uncertainty.transmissibility(result.measurement.freq)  # doctest: +SKIP
    >>> sysid.plot.transmissibility(result, sensor="x5", run="x", band=band)  # doctest: +SKIP
    """
    test = measurement or identification.measurement
    chosen = strongest(test, 1, sensor=sensor, run=run)[0]
    return place(ax, response_channel(identification, test, *chosen, band=band))


def responses(
    identification: Identification,
    sensor: int | str,
    *,
    measurement: Measurement | None = None,
    band: ArrayLike | None = None,
) -> Figure:
    """All runs of one sensor side by side; see `transmissibility`."""
    test = measurement or identification.measurement
    s = named_index("sensor", sensor, test.sensor_names)
    return panels([response_channel(identification, test, s, r, band=band) for r in range(test.n_runs)], alone=10.0)


def base_force(
    identification: Identification,
    ax: Axes | Sequence[Axes] | None = None,
    *,
    direction: int | str = 0,
    run: int | str | None = None,
    measurement: Measurement | None = None,
    band: ArrayLike | None = None,
) -> Any:
    """Measured against identified force of the base on the structure, magnitude and phase.

    Per unit base acceleration (apparent mass, kg) for unit runs, else the force's spectrum.

    Parameters
    ----------
    identification : Identification
    ax : Axes or two Axes, optional
    direction : int or str
        Of the force: index or name of a base direction.
    run : int or str, optional
        As for `transmissibility`; by default the run in which the base moves most in `direction`.
    measurement : Measurement, optional
    band : array_like, shape (d, d, n_freq), optional
        Standard deviation of the apparent mass at the test's lines, kg, such as `Uncertainty.base_force` gives.

    Returns
    -------
    Figure, Axes or the sequence given
    """
    test = with_force(measurement or identification.measurement)
    i = named_index("base direction", direction, test.base_axes or ())
    r = int(np.argmax(np.linalg.norm(test.base[:, i], axis=-1))) if run is None else run_index(test, run)
    return place(ax, force_channel(identification, test, i, r, band=band))


def base_forces(
    identification: Identification,
    run: int | str,
    *,
    measurement: Measurement | None = None,
    band: ArrayLike | None = None,
) -> Figure:
    """All directions of the base force of one run side by side; see `base_force`."""
    test = with_force(measurement or identification.measurement)
    r = run_index(test, run)
    return panels([force_channel(identification, test, i, r, band=band) for i in range(test.n_base)], alone=10.0)


def convergence(identification: Identification, ax: Axes | None = None) -> Any:
    """Objective through the phases that ran: the swarm's best, each iterate of the local phase.

    Each round of Huber's loss weighs its records anew, so that the curve may step up from one to the next.
    Fits with widened peaks on the way are left out; a swarm's curve of such responses is dashed, and says so.
    It is the root of the sum of squares of all that is fitted, so it may differ from the residual, which is of
    accelerations alone and unweighted.
    """
    target, ax = new_axes(ax, 6.0, 3.6)
    history = identification.history
    swarm, local = positive(history.swarm_curve), positive(history.local_curve)
    rounds = sum(phase.evaluations for phase in history.phases if phase.name == HUBER)
    widened = bool(swarm.size) and bool(np.isnan(history.start))
    _draw_curves(ax, swarm, local, rounds=rounds, widened=widened)
    values = np.concatenate([swarm, local])
    values = values[values > 0]
    if values.size:
        low, high = values.min(), values.max()
        ax.set_yscale("log")
        # A curve that hardly falls is shown as flat as it is.
        ax.set_ylim(min(low / (high / low) ** 0.08, 0.6 * low), max(high * (high / low) ** 0.08, 1.6 * high))
        if high < 3 * low:
            plain_log(ax.yaxis, range(1, 10))
        elif high < 30 * low:
            plain_log(ax.yaxis)
    if ax.get_legend_handles_labels()[0]:
        legend_below(ax, ax.get_lines(), 2)
    else:
        ax.text(0.5, 0.5, "no search is recorded", transform=ax.transAxes, ha="center", color=FAINT)
    x_label = "iteration, swarm then local phase" if swarm.size else "iteration"
    dress(ax, "Convergence", x_label, "objective [–]")
    return target


def _draw_curves(ax: Axes, swarm: Array, local: Array, *, rounds: int, widened: bool) -> None:
    """Best of the swarm, and after it the iterates of the local phase.

    The last of these are of the `rounds` of Huber's loss.
    """
    from matplotlib.ticker import MaxNLocator

    end = max(swarm.size - 1, 0)
    if swarm.size:
        label, style = ("swarm, of widened peaks", "--") if widened else ("swarm (best so far)", "-")
        ax.plot(np.arange(swarm.size), swarm, color=COLOURS[0], linewidth=1.6, linestyle=style, label=label)
    else:
        ax.set_xlim(-0.5, max(local.size, 2) - 0.5)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    if local.size:
        # Without a swarm the iterates are few; a single one is no line.
        marker = None if swarm.size and local.size > 1 else "o"
        iterate, ended = end + np.arange(local.size), "local phase, of the records" if widened else "local phase"
        drawn: Any = {"linewidth": 1.6, "marker": marker, "markersize": 3.5}
        first = max(local.size - rounds, 0)
        if first:
            ax.plot(iterate[:first], local[:first], color=COLOURS[5], label=ended, **drawn)
        if rounds:
            rounds_label = "rounds of Huber's loss, each with its own weights"
            ax.plot(iterate[first:], local[first:], color=COLOURS[1], label=rounds_label, **drawn)
    if swarm.size and local.size:
        ax.axvline(end, color=FAINT, linewidth=0.8, linestyle=":")


def mac(identification: Identification, ax: Axes | None = None) -> Any:
    """Modal assurance criterion against the reference where one is known, else the AutoMAC."""
    values = identification.mac
    side = min(2.6 + 0.3 * max(values.shape), 7.0)
    target, ax = new_axes(ax, side + 0.6, side)
    image = ax.imshow(values, cmap="Blues", vmin=0, vmax=1, origin="lower")
    count_cells(ax, values.shape)
    if max(values.shape) <= 12:  # more cells have no room for numbers
        size = 8 if max(values.shape) <= 6 else 6
        for i, j in np.argwhere(values >= 0.005):
            colour = "white" if values[i, j] > 0.55 else INK
            ax.text(j, i, f"{values[i, j]:.2f}", ha="center", va="center", fontsize=size, color=colour)
    colour_bar(image, ax, "MAC [–]")
    known = identification.records.reference is not None
    words = ("MAC against the reference", "mode of the reference") if known else ("AutoMAC", "mode")
    dress(ax, *words, "identified mode", grid=False)
    return target


def effective_masses(identification: Identification, ax: Axes | None = None) -> Any:
    """Effective mass of each mode (bars) and their running sum (lines), % of the rigid-body mass."""
    structure = identification.structure
    names = identification.measurement.base_axes or ()
    share = structure.effective_mass_percent
    modes = np.arange(1, structure.n + 1)
    target, ax = new_axes(ax, min(5.0 + 0.18 * structure.n, 9.0), 3.6)
    width = 0.8 / structure.n_base
    total = np.cumsum(share, axis=0)
    at = modes[:, None] + (np.arange(structure.n_base) - (structure.n_base - 1) / 2) * width
    for i, (name, colour) in enumerate(zip(names, COLOURS, strict=False)):
        ax.bar(at[:, i], share[:, i], width, color=colour, alpha=0.85, label=f"base {name}")
        ax.plot(modes, total[:, i], color=colour, linewidth=1.2, marker="o", markersize=3)
    reference = identification.records.reference
    if reference is not None and reference.n == structure.n:
        size = max(80 / at.size, 4)
        ax.plot(
            at.ravel(), reference.effective_mass_percent.ravel(), "_", color=INK, markersize=size, label="reference"
        )
    ax.axhline(100, color=FAINT, linewidth=0.8, linestyle=":")
    ax.set_ylim(0, max(105.0, 1.05 * float(total.max())))
    count_modes(ax, structure.n)
    dress(ax, "Effective masses and their sum", "mode", "% of rigid-body mass")
    legend_below(ax, ax.get_legend_handles_labels()[0], 4)
    return target


def matrices(identification: Identification, ax: Sequence[Axes] | None = None) -> Any:
    """Heat maps of M_SS, K_SS and C, each entry over the root of its two diagonal entries.

    Parameters
    ----------
    identification : Identification
    ax : three Axes, optional

    Returns
    -------
    Figure, or the axes given
    """
    target: Any = ax
    if ax is None:
        target = new_figure(10.0, 3.6)
        ax = target.subplots(1, 3)
    structure = identification.structure
    n = structure.n
    blocks = {"$M_{SS}$": structure.mass[:n, :n], "$K_{SS}$": structure.stiffness[:n, :n], "$C$": structure.damping}
    rows = ("degree of freedom", "", "")
    for one, (name, matrix), row in zip(ax, blocks.items(), rows, strict=True):
        image = one.imshow(normalised(matrix), cmap="RdBu_r", vmin=-1, vmax=1)
        count_cells(one, matrix.shape)
        dress(one, name, "degree of freedom", row, grid=False, math=True)
    colour_bar(image, list(ax), r"$a_{ij} / \sqrt{a_{ii} a_{jj}}$ [–]")
    return target


def mode_shapes(identification: Identification, modes: Sequence[int] | None = None) -> Figure:
    """Mode shapes in space, one panel a mode: sticks join the base and neighbouring sensors, grey at rest.

    Parameters
    ----------
    identification : Identification
    modes : sequence of int, optional
        From 1; the first six by default.

    Returns
    -------
    Figure

    Raises
    ------
    InputError
        Where the sensors have no positions, or all the same.
    """
    points, motion, sticks = stick_model(identification.measurement)
    structure = identification.structure
    columns = 6
    chosen = range(1, min(structure.n, columns) + 1) if modes is None else modes
    unknown = any(not 1 <= k <= structure.n for k in chosen)
    refuse((unknown, f"modes {list(chosen)}: this structure has modes 1 to {structure.n}"))
    columns = min(len(chosen), columns)
    rows = -(-len(chosen) // columns)
    figure = new_figure(max(1.9 * columns, 3.0), 2.7 * rows)
    extent = np.ptp(points, axis=0)
    box = np.maximum(extent, 0.35 * extent.max())
    centre = (points.max(axis=0) + points.min(axis=0)) / 2
    for at, k in enumerate(chosen):
        ax: Any = figure.add_subplot(rows, columns, at + 1, projection="3d")
        shape = motion @ structure.mode_shapes[:, k - 1]
        moved = points + 0.18 * extent.max() * shape / np.abs(shape).max()
        for where, style in (
            (points, {"color": "#c3cad2", "linewidth": 1.0}),
            (moved, {"color": COLOURS[0], "linewidth": 1.6, "marker": "o", "markersize": 2.5}),
        ):
            for i, j in sticks:
                ax.plot(*where[[i, j]].T, **style)
        _set_box(ax, centre, box)
        ax.set_title(f"mode {k}: {structure.natural_frequencies[k - 1]:.4g} Hz", fontsize=9, color=INK)
    return figure


def _set_box(ax: Any, centre: Array, box: Array) -> None:
    """Limits, labels and view of a picture in space, `box` (3,) wide about `centre` (3,), m."""
    for name, middle, size in zip("xyz", centre, box, strict=True):
        getattr(ax, f"set_{name}lim")(middle - 0.7 * size, middle + 0.7 * size)
        getattr(ax, f"set_{name}label")(f"{name} [m]", fontsize=7, labelpad=-6, color=INK)
        axis = getattr(ax, f"{name}axis")
        axis.set_pane_color((1, 1, 1, 0))
        axis.set_tick_params(labelsize=6, pad=-3, labelcolor=FAINT)
        axis.get_major_locator().set_params(nbins=3)
        if size < 0.5 * box.max():
            getattr(ax, f"set_{name}ticks")([])  # no room for numbers
    ax.grid(False)
    ax.set_box_aspect(box.tolist(), zoom=0.95)  # a list: an array would be scaled in place
    ax.view_init(elev=20, azim=-50)


def stabilisation(subject: Identification | Measurement, ax: Axes | None = None) -> Any:
    """Stabilisation diagram: poles of models of rising order (pLSCF), a second opinion beside the modes found.

    A mode is a column of poles that stay where they are; behind them stands the largest singular value of the FRFs of
    relative acceleration. Dashed lines are the modes of the result or, for a measurement alone, those that vector
    fitting finds. Where no FRF follows from the runs, the spectra and the modes are shown without poles, and why. With
    Huber's loss the records are shown without outliers that stand alone.

    See Also
    --------
    sysid.modal_analysis.stabilisation.stabilisation : The same as numbers.
    """
    target, ax = new_axes(ax, 6.4, 4.2)
    draw_stabilisation(ax, subject)
    return target


def cmif(subject: Identification | Measurement, ax: Axes | None = None) -> Any:
    """Complex mode indicator function: singular values of the FRFs of relative acceleration over frequency.

    Two that peak at one line are two modes there. Dashed lines as in `stabilisation`. Where no FRF follows from the
    runs, the singular values are those of the runs' own spectra, and the picture says so.

    See Also
    --------
    sysid.modal_analysis.stabilisation.cmif : The same as numbers.
    """
    target, ax = new_axes(ax, 6.4, 3.8)
    draw_cmif(ax, subject)
    return target


def amplitude(identification: Identification) -> Figure:
    """Frequency and damping ratio of the modes that follow their amplitude, against their level; a row a mode.

    Curves are the law with its 95 % interval, over the levels tested, which are shaded, and a little beyond. Points are
    linear modes of stretches of the fitted records, each at the level of its mean square. Where the level changes
    within a stretch, its damping ratio is too large: one pole takes a frequency that wanders for damping.

    Raises
    ------
    InputError
        Where no mode follows its amplitude.
    """
    structure, modal = identification.structure, identification.modal[0]
    refuse((not structure.laws, "amplitude: no mode of this result follows its amplitude"))
    try:
        stretches = stretches_of(modal.given, 2 * np.pi * structure.natural_frequencies, structure.damping_ratios)
    except (InputError, np.linalg.LinAlgError):  # records too short for stretches: the law stands alone
        stretches = []
    figure = new_figure(9.0, 3.4 * len(structure.laws))
    for row, law in zip(figure.subplots(len(structure.laws), 2, squeeze=False), structure.laws, strict=True):
        draw_law(row, law, stretches)
    legend_below(row[0], row[0].get_legend_handles_labels()[0], 2)
    for ax in row:
        ax.set_xlabel("level [m/s²]")
    return figure


def overview(identification: Identification, *, title: str | None = None) -> Figure:
    """One figure that tells the result: three responses, convergence or poles, MAC, effective masses.

    Parameters
    ----------
    identification : Identification
    title : str, optional

    Returns
    -------
    Figure
        12 in wide: 1200 pixels at 100 dpi.
    """
    test = identification.measurement
    figure = new_figure(12.0, 7.4)
    top, bottom = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=[1.08, 1]), dtype=object))
    chosen = strongest(test, min(3, test.n_sensors))
    above = top.subplots(2, len(chosen), height_ratios=[2.3, 1], sharex="col", squeeze=False)
    for column, (sensor, run) in enumerate(chosen):
        channel = response_channel(identification, test, sensor, run)
        draw(above[:, column], channel)
    for row in above:
        label_once(row)
    above[0, 0].legend(handles=key(above[0]), frameon=False, fontsize="small")
    below = bottom.subplots(1, 3, width_ratios=[1.15, 1, 1.25])
    search = convergence if identification.history.swarm_curve.size else stabilisation
    search(identification, below[0])
    mac(identification, below[1])
    effective_masses(identification, below[2])
    if title is None:
        from pathlib import PurePath

        recipe = identification.recipe
        head = f"{PurePath(recipe.module).stem}: " if recipe else ""
        channels = f"{counted(test.n_sensors, 'sensor')}, {counted(test.n_base, 'base direction')}"
        title = f"{head}{channels}, residual {identification.residual:.2e}"
    figure.suptitle(title, fontsize=13, color=INK, parse_math=False)
    return figure


def normalised(matrix: Array) -> Array:
    """Each entry over the root of its two diagonal entries; zero where one of these is."""
    root = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    outer = np.outer(root, root)
    return np.divide(matrix, outer, out=np.zeros_like(outer), where=outer > 0)


def stick_model(test: Measurement) -> tuple[Array, Array, list[tuple[int, int]]]:
    """The base and the sensors (p, 3), their motion by each sensor (p, 3, n_sensors), and pairs that a stick joins.

    The base comes first, at the origin. Refused where the sensors have no positions, or all the same.
    """
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import pdist, squareform

    sensors = test.sensors
    if sensors is None:
        raise InputError("mode_shapes: the sensors are not described; give the measurement sysid.Sensor objects")
    points, owner = np.unique(np.array([s.position for s in sensors], float).round(9), axis=0, return_inverse=True)
    refuse((len(points) < 2, "mode_shapes: all sensors are described at one place; positions are needed"))
    motion = np.zeros((1 + len(points), 3, len(sensors)))
    for s, (sensor, p) in enumerate(zip(sensors, np.ravel(owner), strict=True)):
        motion[1 + p, :, s] = axis_vector(sensor.axis)
    points = np.vstack([np.zeros(3), points])
    tree = minimum_spanning_tree(squareform(pdist(points))).tocoo()
    return points, motion, list(zip(tree.row.tolist(), tree.col.tolist(), strict=True))
