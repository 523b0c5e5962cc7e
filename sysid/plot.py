"""Pictures of an identification, for notebooks and for the report.

Each function draws into the axes that it is given and returns them; without, it makes a figure and
returns that. The figures do not belong to pyplot: nothing stays open, no display is needed, and a
notebook shows the one that a cell ends with. ``sysid.plot.mac(result).savefig("mac.png")`` writes one.

Measured is thin and dark, identified dashed and coloured above it, their difference faint.
"""

from __future__ import annotations

import functools
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from sysid.errors import InputError
from sysid.identification import Identification
from sysid.measurement import Measurement, axis_vector, unit_runs
from sysid.structure import Array, ComplexArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED: dict[str, Any] = {"color": "#1f2430", "linewidth": 1.0, "label": "measured"}
IDENTIFIED: dict[str, Any] = {"color": "#D55E00", "linewidth": 1.6, "linestyle": (0, (3, 2.2)), "label": "identified"}
RESIDUAL: dict[str, Any] = {"color": "#b4bfca", "linewidth": 0.8, "label": "difference", "zorder": 1}
# Okabe and Ito's palette: told apart with any colour vision.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")

_INK, _FAINT, _GRID = "#3c4450", "#8a94a0", "#e4e8ec"
_ROUND_OFF = 1e-10  # of the largest channel: below it a response is arithmetic, not motion
_COLUMNS = 3
_PANEL_WIDTHS = {2: 5.6, 3: 4.0}  # in, by the number of columns
_MAX_NUMBERS = 12  # modes up to which a MAC's cells carry their numbers
_MAX_SHAPES = 6
_DENSE = 800  # lines beyond which curves are drawn thinner


class Channel(NamedTuple):
    """One record of a test and what the model answers: spectra (n_freq,), and the words for a picture."""

    freq: Array
    measured: ComplexArray
    identified: ComplexArray
    against: ComplexArray  # what the phase is told against
    title: str
    quantity: str
    phase: str
    negligible: bool


def transmissibility(
    identification: Identification,
    ax: Axes | Sequence[Axes] | None = None,
    *,
    sensor: int | str | None = None,
    run: int | str | None = None,
    measurement: Measurement | None = None,
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
        Index; of unit runs also the base direction's name, such as "x".
    measurement : Measurement, optional
        Another test of the same sensors to predict, such as a validation; the one fitted by default.

    Returns
    -------
    Figure, Axes or the sequence given

    Examples
    --------
    >>> import numpy as np
    >>> import sysid
    >>> result = sysid.load("results/cantilever_tower")  # doctest: +SKIP
    >>> sysid.plot.transmissibility(result, sensor="tip x", run="x")  # doctest: +SKIP
    """
    test = identification.measurement if measurement is None else measurement
    chosen = strongest(test, 1, sensor=sensor, run=run)[0]
    return _place(ax, _response(identification, test, *chosen))


def responses(identification: Identification, sensor: int | str, *, measurement: Measurement | None = None) -> Figure:
    """All runs of one sensor side by side; see `transmissibility`."""
    test = identification.measurement if measurement is None else measurement
    s = _sensor_index(test, sensor)
    return _panels([_response(identification, test, s, r) for r in range(test.n_runs)], alone=10.0)


def base_force(
    identification: Identification,
    ax: Axes | Sequence[Axes] | None = None,
    *,
    direction: int | str = 0,
    run: int | str | None = None,
    measurement: Measurement | None = None,
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
        Index or, of unit runs, name; by default the run in which the base moves most in `direction`.
    measurement : Measurement, optional

    Returns
    -------
    Figure, Axes or the sequence given
    """
    test = _with_force(identification.measurement if measurement is None else measurement)
    i = _index("base direction", direction, test.base_axes or ())
    r = int(np.argmax(np.linalg.norm(test.base[:, i], axis=-1))) if run is None else _run_index(test, run)
    return _place(ax, _force(identification, test, i, r))


def base_forces(identification: Identification, run: int | str, *, measurement: Measurement | None = None) -> Figure:
    """All directions of the base force of one run side by side; see `base_force`."""
    test = _with_force(identification.measurement if measurement is None else measurement)
    r = _run_index(test, run)
    return _panels([_force(identification, test, i, r) for i in range(test.n_base)], alone=10.0)


def convergence(identification: Identification, ax: Axes | None = None) -> Any:
    """Residual through the phases: the swarm's best, the refinement, each iterate of the local phase.

    With a measured force both curves count it too; what is marked after the refinement does not.

    Parameters
    ----------
    identification : Identification
    ax : Axes, optional

    Returns
    -------
    Figure or Axes
    """
    figure, ax = _axes(ax, 6.0, 3.6)
    history = identification.history
    swarm, local = _positive(history.swarm_curve), _positive(history.local_curve)
    end = max(swarm.size - 1, 0)
    if swarm.size:
        ax.plot(np.arange(swarm.size), swarm, color=COLOURS[0], linewidth=1.6, label="swarm (best so far)")
    if local.size:
        ax.plot(end + np.arange(local.size), local, color=COLOURS[5], linewidth=1.6, label="local phase")
    if swarm.size and local.size:
        ax.axvline(end, color=_FAINT, linewidth=0.8, linestyle=":")
    if history.refinement > 0:
        ax.plot([end], [history.refinement], "D", color=_INK, markersize=5, label="after refinement", zorder=4)
    goal = identification.problem.goal
    if goal is not None:
        ax.axhline(goal, color=_FAINT, linewidth=0.8, linestyle="--", label=f"goal {goal:.3g}")
    values = np.concatenate([swarm, local, [history.refinement, goal or np.nan]])
    if np.any(values > 0):
        ax.set_yscale("log")
        ax.margins(y=0.08)
        if np.nanmax(values) < 30 * np.nanmin(values):
            _plain_log(ax.yaxis)
    if ax.get_legend_handles_labels()[0]:
        ax.legend(frameon=False, fontsize="small")
    else:
        ax.text(0.5, 0.5, "no search is recorded", transform=ax.transAxes, ha="center", color=_FAINT)
    both = " (with the force)" if identification.measurement.force is not None else ""
    _dress(ax, "Convergence", "iteration, swarm then local phase", f"relative residual{both} [–]")
    return ax if figure is None else figure


def mac(identification: Identification, ax: Axes | None = None) -> Any:
    """Modal assurance criterion against the reference where one is known, else the AutoMAC.

    Parameters
    ----------
    identification : Identification
    ax : Axes, optional

    Returns
    -------
    Figure or Axes
    """
    values = identification.mac
    known = identification.problem.reference is not None
    side = min(2.6 + 0.3 * max(values.shape), 7.0)
    figure, ax = _axes(ax, side + 0.6, side)
    image = ax.imshow(values, cmap="Blues", vmin=0, vmax=1, origin="lower")
    _cells(ax, values.shape)
    if max(values.shape) <= _MAX_NUMBERS:
        size = 8 if max(values.shape) <= 6 else 6
        for (i, j), value in np.ndenumerate(values):
            if value >= 0.005:
                colour = "white" if value > 0.55 else _INK
                ax.text(j, i, f"{value:.2f}", ha="center", va="center", fontsize=size, color=colour)
    _scale(image, ax, "MAC [–]")
    other = "mode of the reference" if known else "mode"
    _dress(ax, "MAC against the reference" if known else "AutoMAC", other, "identified mode", grid=False)
    return ax if figure is None else figure


def effective_masses(identification: Identification, ax: Axes | None = None) -> Any:
    """Effective mass of each mode (bars) and their running sum (lines), % of the rigid-body mass.

    Parameters
    ----------
    identification : Identification
    ax : Axes, optional

    Returns
    -------
    Figure or Axes
    """
    structure = identification.structure
    names = identification.measurement.base_axes or ()
    share = mass_shares(structure)
    modes = np.arange(1, structure.n + 1)
    figure, ax = _axes(ax, min(5.0 + 0.18 * structure.n, 9.0), 3.6)
    width = 0.8 / structure.n_base
    for i, name in enumerate(names):
        colour = COLOURS[i % len(COLOURS)]
        total = np.cumsum(share[:, i])
        at = modes + (i - (structure.n_base - 1) / 2) * width
        ax.bar(at, share[:, i], width, color=colour, alpha=0.85, label=f"base {name}")
        ax.plot(modes, total, color=colour, linewidth=1.2, marker="o", markersize=3)
        reference = identification.problem.reference
        if reference is not None and reference.n == structure.n:
            last = i == structure.n_base - 1
            size = max(80 / (structure.n * structure.n_base), 4)
            label = "reference" if last else None
            ax.plot(at, mass_shares(reference)[:, i], "_", color=_INK, markersize=size, label=label)
    ax.axhline(100, color=_FAINT, linewidth=0.8, linestyle=":")
    ax.set_ylim(0, max(105.0, 1.05 * float(np.cumsum(share, axis=0).max())))
    _few_modes(ax, structure.n)
    ax.legend(frameon=False, fontsize="small", loc="center right")
    _dress(ax, "Effective masses and their sum", "mode", "% of rigid-body mass")
    return ax if figure is None else figure


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
    figure = None
    if ax is None:
        figure = _figure(10.0, 3.6)
        ax = figure.subplots(1, 3)
    structure = identification.structure
    n = structure.n
    blocks = {"$M_{SS}$": structure.mass[:n, :n], "$K_{SS}$": structure.stiffness[:n, :n], "$C$": structure.damping}
    for one, (name, matrix) in zip(ax, blocks.items(), strict=True):
        image = one.imshow(normalised(matrix), cmap="RdBu_r", vmin=-1, vmax=1)
        _cells(one, matrix.shape)
        _dress(one, name, "sensor", "sensor" if one is ax[0] else "", grid=False, math=True)
    _scale(image, list(ax), r"$a_{ij} / \sqrt{a_{ii} a_{jj}}$ [–]")
    return ax if figure is None else figure


def mode_shapes(identification: Identification, modes: Sequence[int] | None = None) -> Figure:
    """Mode shapes in space, one panel a mode: sticks join neighbouring sensors, grey at rest.

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
    points, motion, sticks = _geometry(identification)
    structure = identification.structure
    chosen = range(1, min(structure.n, _MAX_SHAPES) + 1) if modes is None else modes
    if any(not 1 <= k <= structure.n for k in chosen):
        raise InputError(f"modes {list(chosen)}: this structure has modes 1 to {structure.n}")
    columns = min(len(chosen), 6)
    rows = -(-len(chosen) // columns)
    figure = _figure(max(1.9 * columns, 3.0), 2.7 * rows)
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
        for name, middle, size in zip("xyz", centre, box, strict=True):
            getattr(ax, f"set_{name}lim")(middle - 0.7 * size, middle + 0.7 * size)
            getattr(ax, f"set_{name}label")(f"{name} [m]", fontsize=7, labelpad=-6, color=_INK)
            axis = getattr(ax, f"{name}axis")
            axis.set_pane_color((1, 1, 1, 0))
            axis.set_tick_params(labelsize=6, pad=-3, labelcolor=_FAINT)
            axis.get_major_locator().set_params(nbins=3)
            if size < 0.5 * box.max():
                getattr(ax, f"set_{name}ticks")([])  # no room for numbers
        ax.grid(False)
        ax.set_box_aspect(box.tolist(), zoom=1.05)  # a list: an array would be scaled in place
        ax.view_init(elev=20, azim=-50)
        ax.set_title(f"mode {k}: {structure.natural_frequencies[k - 1]:.4g} Hz", fontsize=9, color=_INK)
    return figure


def overview(identification: Identification, *, title: str | None = None) -> Figure:
    """One figure that tells the result: three responses, convergence, MAC, effective masses.

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
    figure = _figure(12.0, 7.4)
    top, bottom = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=[1.08, 1]), dtype=object))
    chosen = strongest(test, min(3, test.n_sensors))
    above = top.subplots(2, len(chosen), height_ratios=[2.3, 1], sharex="col", squeeze=False)
    for column, (sensor, run) in enumerate(chosen):
        channel = _response(identification, test, sensor, run)
        _draw(above[:, column], channel)
        if column:
            for ax in above[:, column]:
                ax.set_ylabel("")
    above[0, 0].legend(handles=_key(above[0, 0]), frameon=False, fontsize="small")
    below = bottom.subplots(1, 3, width_ratios=[1.15, 1, 1.25])
    convergence(identification, below[0])
    mac(identification, below[1])
    effective_masses(identification, below[2])
    if title is None:
        from pathlib import PurePath

        recipe = identification.recipe
        head = f"{PurePath(recipe.module).stem}: " if recipe else ""
        title = f"{head}{test.n_sensors} sensors, {test.n_base} base directions, residual {identification.residual:.2e}"
    figure.suptitle(title, fontsize=13, color=_INK, parse_math=False)
    return figure


def strongest(
    test: Measurement, count: int, *, sensor: int | str | None = None, run: int | str | None = None
) -> list[tuple[int, int]]:
    """Pairs (sensor, run) with the largest relative accelerations, of different sensors, the runs in turn."""
    energy = np.linalg.norm(test.relative, axis=-1)
    sensors = range(test.n_sensors) if sensor is None else [_sensor_index(test, sensor)]
    runs = range(test.n_runs) if run is None else [_run_index(test, run)]
    free = list(sensors)
    chosen: list[tuple[int, int]] = []
    first = max(runs, key=lambda r: energy[r, free].max())
    while free and len(chosen) < count:
        r = runs[(runs.index(first) + len(chosen)) % len(runs)]
        s = max(free, key=lambda s: energy[r, s])
        free.remove(s)
        chosen.append((s, r))
    return chosen


def is_unit(test: Measurement) -> bool:
    """Whether run i is unit motion in base direction i alone, so that responses are transmissibilities."""
    return test.n_runs == test.n_base and np.array_equal(test.base, unit_runs(test.n_base, test.freq.size))


def run_names(test: Measurement) -> tuple[str, ...]:
    """Give what a run is called in a title: "base x" for unit runs, else "run 1"."""
    if is_unit(test):
        return tuple(f"base {name}" for name in test.base_axes or ())
    return tuple(f"run {r + 1}" for r in range(test.n_runs))


def mass_shares(structure: Any) -> Array:
    """Effective masses in % of the rigid-body mass, (n, d); zero where a direction has no mass."""
    rigid = np.diag(structure.rigid_body_mass)
    return 100 * np.einsum("kii->ki", structure.effective_masses) / np.where(rigid > 0, rigid, np.inf)


def normalised(matrix: Array) -> Array:
    """Each entry over the root of its two diagonal entries; zero where one of these is."""
    root = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    outer = np.outer(root, root)
    return np.divide(matrix, outer, out=np.zeros_like(outer), where=outer > 0)


def to_png(figure: Figure, *, dpi: float = 100, colours: int | None = None) -> bytes:
    """PNG of a figure; with `colours`, in a palette of so many, which is a third of the size."""
    import warnings

    from matplotlib.backends.backend_agg import FigureCanvasAgg

    out = io.BytesIO()
    with warnings.catch_warnings():
        # A sensor's name may be in a script that the font lacks; a box in its place will do.
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        FigureCanvasAgg(figure)
        figure.savefig(out, format="png", dpi=dpi, facecolor="white", metadata={"Software": None})
    if colours is None:
        return out.getvalue()
    from PIL import Image  # matplotlib's own dependency

    small = io.BytesIO()
    Image.open(out).convert("RGB").quantize(colours, dither=Image.Dither.NONE).save(small, format="png", optimize=True)
    return small.getvalue()


def _response(identification: Identification, test: Measurement, sensor: int, run: int) -> Channel:
    predicted = test.predict(identification.structure)[run, sensor] + test.rigid_body[sensor] @ test.base[run]
    title = f"{test.sensor_names[sensor]}, {run_names(test)[run]}"
    largest = np.abs(test.response).max()
    lever = "" if test.translational[run % test.n_base] else "m"
    words = ("transmissibility", lever) if is_unit(test) else ("acceleration", "m/s²")
    return _channel(test, test.response[run, sensor], predicted, run, title, *words, largest)


def _force(identification: Identification, test: Measurement, direction: int, run: int) -> Channel:
    assert test.force is not None and test.base_axes is not None
    predicted = test.predict_force(identification.structure)[run, direction]
    turns = not test.translational[direction]
    name = f"{'moment about' if turns else 'force'} {test.base_axes[direction].removeprefix('r' if turns else '')}"
    title = f"{name}, {run_names(test)[run]}"
    words = ("force", "N m" if turns else "N")
    if is_unit(test):
        words = ("apparent mass", ("kg", "kg m", "kg m²")[int(turns) + int(not test.translational[run])])
    largest = np.abs(test.force[:, direction]).max()
    return _channel(test, test.force[run, direction], predicted, run, title, *words, largest)


def _channel(
    test: Measurement, measured: ComplexArray, predicted: ComplexArray, run: int, title: str, what: str, unit: str,
    largest: float,
) -> Channel:  # fmt: skip
    negligible = bool(np.abs(measured).max() <= _ROUND_OFF * largest)
    if is_unit(test):
        ones = np.ones_like(measured)
        return Channel(test.freq, measured, predicted, ones, title, f"{what} [{unit or '–'}]", "phase [°]", negligible)
    moved = int(np.argmax(np.linalg.norm(test.base[run], axis=-1)))
    assert test.base_axes is not None
    # The scale of a spectrum (a line, per Hz, one-sided) is the record's own affair.
    return Channel(
        test.freq, measured, predicted, test.base[run, moved], title, f"{what} spectrum\n[{unit}, own scale]",
        f"phase to\nbase {test.base_axes[moved]} [°]", negligible,
    )  # fmt: skip


def _place(ax: Axes | Sequence[Axes] | None, channel: Channel) -> Any:
    if ax is None:
        return _panels([channel])
    _draw(np.ravel(np.asarray(ax, dtype=object)), channel)
    return ax


def _panels(channels: Sequence[Channel], *, alone: float = 6.4) -> Figure:
    """Magnitude above phase, a column a channel, at most three columns; `alone` is the width of one, in."""
    from matplotlib.ticker import NullLocator

    columns = min(len(channels), _COLUMNS)
    blocks = -(-len(channels) // columns)
    width, height = alone if columns == 1 else _PANEL_WIDTHS[columns] * columns, 3.5 * blocks + 0.25
    figure = _figure(width, height, layout=None)  # as regular as these panels are, and three times as fast
    left = 0.92 if "\n" in channels[0].quantity else 0.72
    grid = figure.add_gridspec(
        blocks, columns, left=left / width, right=1 - 0.12 / width, bottom=0.75 / height, top=1 - 0.3 / height,
        wspace=0.24, hspace=0.3,
    )  # fmt: skip
    for at, channel in enumerate(channels):
        axes: Any = grid[divmod(at, columns)].subgridspec(2, 1, height_ratios=[2.2, 1], hspace=0.12).subplots()
        _draw(axes, channel)
        axes[0].yaxis.set_minor_locator(NullLocator())  # most of the time goes into ticks
        # What is shared along a row is said once.
        if at % columns and channel.quantity == channels[at - 1].quantity:
            axes[0].set_ylabel("")
        if at % columns and channel.phase == channels[at - 1].phase:
            axes[1].set_ylabel("")
    figure.legend(handles=_key(axes[0]), loc="lower center", ncols=3, frameon=False, fontsize="small")
    return figure


def _key(magnitude: Axes) -> list[Any]:
    """Give the lines of a legend in the order in which they are told."""
    lines = {line.get_label(): line for line in magnitude.get_lines()}
    return [lines[style["label"]] for style in (MEASURED, IDENTIFIED, RESIDUAL)]


def _draw(axes: Any, channel: Channel) -> None:
    """Draw magnitude into the first of `axes` and phase into the second, where there is one."""
    freq, measured, identified = channel.freq, channel.measured, channel.identified
    magnitude = axes[0]
    # Whole-record spectra have thousands of lines, which at full width would hide each other.
    thin = {"linewidth": 0.7} if freq.size > _DENSE else {}
    shown, answered = MEASURED | thin, IDENTIFIED | thin
    size, error = _positive(np.abs(measured)), _positive(np.abs(identified - measured))
    magnitude.plot(freq, error, **RESIDUAL)
    magnitude.plot(freq, size, **shown)
    magnitude.plot(freq, _positive(np.abs(identified)), **answered)
    lowest, highest = _span(size, _positive(np.abs(identified)), error)
    if highest > 0:
        magnitude.set_yscale("log")
        magnitude.set_ylim(lowest, highest)
        if highest < 30 * lowest:
            _plain_log(magnitude.yaxis)
    _dress(magnitude, channel.title, "frequency [Hz]" if len(axes) == 1 else "", channel.quantity)
    if channel.negligible:
        magnitude.text(0.5, 0.06, "round-off: no response", transform=magnitude.transAxes, ha="center", color=_FAINT)
    for ax in axes[:2]:
        if freq[0] > 0 and freq[-1] > 10 * freq[0]:
            ax.set_xscale("log")
            _plain_log(ax.xaxis)
        ax.set_xlim(freq[0], freq[-1] if freq.size > 1 else freq[0] + 1)
    if len(axes) > 1:
        magnitude.tick_params(which="both", labelbottom=False)
        phase = axes[1]
        for record, style in ((measured, shown), (identified, answered)):
            phase.plot(*_wrapped(freq, np.angle(record * np.conj(channel.against), deg=True)), **style)
        phase.set_ylim(-190, 190)
        phase.set_yticks([-180, -90, 0, 90, 180], ["−180", "", "0", "", "180"])
        _dress(phase, "", "frequency [Hz]", channel.phase)


def _span(measured: Array, identified: Array, error: Array) -> tuple[float, float]:
    """Limits of a magnitude axis: all of the measured one, and the difference where it is not far below."""
    if not np.any(measured > 0) and not np.any(identified > 0):
        return 0.0, 0.0
    both = np.concatenate([measured, identified])
    top = float(np.nanmax(both))
    shown = [0.5 * float(np.nanmin(both))]
    if np.any(error > 0):
        shown.append(0.5 * float(np.nanmedian(error)))
    return max(min(shown), 1e-5 * top), 1.8 * top


def _wrapped(freq: Array, degrees: Array) -> tuple[Array, Array]:
    """Break a phase curve where it wraps, rather than draw a line across the picture."""
    jumps = np.flatnonzero(np.abs(np.diff(degrees)) > 180) + 1
    return np.insert(freq, jumps, np.nan), np.insert(degrees, jumps, np.nan)


def _positive(values: Array) -> Array:
    """NaN, which is not drawn, in place of what a logarithmic axis cannot show."""
    return np.where(values > 0, values, np.nan)


def _geometry(identification: Identification) -> tuple[Array, Array, list[tuple[int, int]]]:
    """Points (p, 3); each sensor's share in their motion (p, 3, n_sensors); pairs of points that a stick joins."""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import pdist, squareform

    sensors = identification.measurement.sensors
    if sensors is None:
        raise InputError("mode_shapes: the sensors are not described; give the measurement sysid.Sensor objects")
    points, owner = np.unique(np.array([s.position for s in sensors], float).round(9), axis=0, return_inverse=True)
    if len(points) < 2:
        raise InputError("mode_shapes: all sensors are described at one place; positions are needed")
    motion = np.zeros((len(points), 3, len(sensors)))
    for s, (sensor, p) in enumerate(zip(sensors, np.ravel(owner), strict=True)):
        motion[p, :, s] = axis_vector(sensor.axis)
    tree = minimum_spanning_tree(squareform(pdist(points))).tocoo()
    return points, motion, list(zip(tree.row.tolist(), tree.col.tolist(), strict=True))


def _index(what: str, value: int | str, names: Sequence[str]) -> int:
    if isinstance(value, str):
        if value not in names:
            raise InputError(f"{what} {value!r} is unknown; there are {', '.join(names)}")
        return list(names).index(value)
    if not -len(names) <= value < len(names):
        raise InputError(f"{what} {value} is out of range; there are {len(names)}")
    return int(value) % len(names)


def _sensor_index(test: Measurement, sensor: int | str) -> int:
    return _index("sensor", sensor, test.sensor_names)


def _run_index(test: Measurement, run: int | str) -> int:
    names = (test.base_axes or ()) if is_unit(test) else run_names(test)
    return _index("run", run, names)


def _with_force(test: Measurement) -> Measurement:
    if test.force is None:
        raise InputError("base_force: this measurement has no base force")
    return test


@functools.cache
def _figure_class() -> type[Figure]:
    from matplotlib.figure import Figure

    class Picture(Figure):
        """A figure that a notebook shows without pyplot."""

        def _repr_png_(self) -> bytes:
            return to_png(self)

    return Picture


def _figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    return _figure_class()(figsize=(width, height), layout=layout)


def _axes(ax: Axes | None, width: float, height: float) -> tuple[Figure | None, Any]:
    """Give the figure, where it had to be made, and the axes."""
    if ax is not None:
        return None, ax
    figure = _figure(width, height)
    return figure, figure.subplots()


def _dress(ax: Axes, title: str, x: str, y: str, *, grid: bool = True, math: bool = False) -> None:
    """Give axes their words and the house's look."""
    if title:
        ax.set_title(title, fontsize=10, color=_INK, parse_math=math, y=1.0)  # a stated y is not searched for: faster
    ax.set_xlabel(x, fontsize=9, color=_INK)
    ax.set_ylabel(y, fontsize=9, color=_INK)
    ax.tick_params(which="both", labelsize=8, color=_FAINT, labelcolor=_INK)
    ax.tick_params(which="minor", length=2)
    for name, spine in ax.spines.items():
        spine.set_visible(not grid or name in ("left", "bottom"))
        spine.set_color(_FAINT)
    if grid:
        ax.grid(True, which="major", color=_GRID, linewidth=0.7)
        ax.set_axisbelow(True)


def _scale(image: Any, ax: Any, label: str) -> None:
    """Set a colour bar beside the axes of a heat map."""
    bar = image.figure.colorbar(image, ax=ax, shrink=0.85, pad=0.02)
    bar.set_label(label, fontsize=9, color=_INK)
    bar.ax.tick_params(labelsize=8, color=_FAINT, labelcolor=_INK)
    bar.outline.set_edgecolor(_FAINT)


def _cells(ax: Axes, shape: tuple[int, ...]) -> None:
    """Count the rows and columns of a heat map from 1, not all where they are many."""
    for size, put in ((shape[1], ax.set_xticks), (shape[0], ax.set_yticks)):
        ticks = np.arange(0, size, max(1, -(-size // 12)))
        put(ticks, [str(i + 1) for i in ticks])


def _few_modes(ax: Axes, n: int) -> None:
    ax.set_xlim(0.4, n + 0.6)
    ax.set_xticks(np.arange(1, n + 1, max(1, -(-n // 12))))


def _plain_log(axis: Any) -> None:
    """Ticks of a short logarithmic axis at 1, 2, 5, in plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
