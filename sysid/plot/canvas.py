"""Figures, axes and the style that all pictures share."""

from __future__ import annotations

import contextlib
import functools
import io
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from sysid.structure.structure import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MEASURED: dict[str, Any] = {"color": "#1f2430", "linewidth": 1.0, "label": "measured"}
IDENTIFIED: dict[str, Any] = {"color": "#D55E00", "linewidth": 1.6, "linestyle": (0, (3, 2.2)), "label": "identified"}
RESIDUAL: dict[str, Any] = {"color": "#b4bfca", "linewidth": 0.8, "label": "difference", "zorder": 1}
# Okabe and Ito's palette: told apart with any colour vision.
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00")

INK, FAINT, GRID = "#3c4450", "#8a94a0", "#e4e8ec"


def to_png(figure: Figure, *, dpi: float = 100, colours: int | None = None) -> bytes:
    """PNG of a figure; with `colours`, in a palette of so many, which is a third of the size."""
    return _png(_drawn(figure, dpi), dpi, colours)


def heat_map(values: Array, colours: str, low: float) -> bytes:
    """PNG of a matrix, a pixel an entry, in one of Matplotlib's colour maps from `low` to 1."""
    from matplotlib import colormaps

    return _png(colormaps[colours]((values - low) / (1 - low), bytes=True)[..., :3])


def _png(pixels: NDArray[np.uint8], dpi: float = 100, colours: int | None = None) -> bytes:
    """PNG of pixels (rows, columns, 3), in a palette of so many colours if that is given."""
    from PIL import Image  # matplotlib's own dependency

    image = Image.fromarray(pixels)
    if colours is not None:
        image = image.quantize(colours, dither=Image.Dither.NONE)
    out = io.BytesIO()
    image.save(out, format="png", dpi=(dpi, dpi))
    return out.getvalue()


def _drawn(figure: Figure, dpi: float) -> NDArray[np.uint8]:
    """Pixels of a figure on white, (rows, columns, 3).

    Drawn once: where the layout is found by drawing, `savefig` draws twice.
    """
    import warnings

    from matplotlib.backends.backend_agg import FigureCanvasAgg

    before = figure.dpi, figure.get_facecolor()
    canvas = FigureCanvasAgg(figure)
    try:
        figure.set_dpi(dpi)
        figure.set_facecolor("white")
        with warnings.catch_warnings():
            # A sensor's name may be in a script that the font lacks; a box in its place will do.
            warnings.filterwarnings("ignore", message="Glyph .* missing from")
            canvas.draw()
        return np.array(canvas.buffer_rgba())[..., :3]
    finally:
        figure.set_dpi(before[0])
        figure.set_facecolor(before[1])


@contextlib.contextmanager
def default_style() -> Iterator[None]:
    """Draw with matplotlib's own settings, whatever a problem module or the machine has set."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        yield


@functools.cache
def _figure_class() -> type[Figure]:
    from matplotlib.figure import Figure

    class Picture(Figure):
        """A figure that a notebook shows without pyplot."""

        def _repr_png_(self) -> bytes:
            return to_png(self)

    return Picture


def new_figure(width: float, height: float, layout: Literal["constrained"] | None = "constrained") -> Figure:
    """An empty figure, width and height in inches."""
    return _figure_class()(figsize=(width, height), layout=layout)


def new_axes(ax: Axes | None, width: float, height: float) -> tuple[Axes | Figure, Any]:
    """Return value of a picture, and the axes it is drawn into: those given, or a new figure and its axes."""
    if ax is not None:
        return ax, ax
    figure = new_figure(width, height)
    return figure, figure.subplots()


def dress(ax: Axes, title: str, x: str, y: str, *, grid: bool = True, math: bool = False) -> None:
    """Set title, labels and the common style of axes."""
    ax.set_title(title, fontsize=10, color=INK, parse_math=math, y=1.0)  # a stated y is not searched for: faster
    ax.set_xlabel(x, fontsize=9, color=INK)
    ax.set_ylabel(y, fontsize=9, color=INK)
    ax.tick_params(which="both", labelsize=8, color=FAINT, labelcolor=INK)
    ax.tick_params(which="minor", length=2)
    for name, spine in ax.spines.items():
        spine.set_visible(not grid or name in ("left", "bottom"))
        spine.set_color(FAINT)
    if grid:
        ax.grid(True, which="major", color=GRID, linewidth=0.7)
        ax.set_axisbelow(True)


def colour_bar(image: Any, ax: Any, label: str) -> None:
    """Set a colour bar beside the axes of a heat map."""
    bar = image.figure.colorbar(image, ax=ax, shrink=0.85, pad=0.02)
    bar.set_label(label, fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8, color=FAINT, labelcolor=INK)
    bar.outline.set_edgecolor(FAINT)


def count_cells(ax: Axes, shape: tuple[int, ...]) -> None:
    """Count the rows and columns of a heat map from 1, not all where they are many."""
    for size, put in ((shape[1], ax.set_xticks), (shape[0], ax.set_yticks)):
        ticks = np.arange(0, size, max(1, -(-size // 12)))
        put(ticks, [str(i + 1) for i in ticks])


def count_modes(ax: Axes, n: int) -> None:
    """Count modes 1 to n along the x axis, not all where they are many."""
    ax.set_xlim(0.4, n + 0.6)
    ax.set_xticks(np.arange(1, n + 1, max(1, -(-n // 12))))


def frequency_axis(ax: Axes, freq: Array) -> None:
    """Limit the x axis to `freq` (n_freq,), Hz; logarithmic over more than a decade."""
    if freq[0] > 0 and freq[-1] > 10 * freq[0]:
        ax.set_xscale("log")
        plain_log(ax.xaxis)
    ax.set_xlim(freq[0], freq[-1] if freq.size > 1 else freq[0] + 1)


def positive(values: Array) -> Array:
    """NaN, which is not drawn, in place of what a logarithmic axis cannot show."""
    return np.where(values > 0, values, np.nan)


def plain_log(axis: Any, at: Sequence[float] = (1.0, 2.0, 5.0)) -> None:
    """Ticks of a short logarithmic axis at such multiples of powers of ten, in plain numbers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    axis.set_major_locator(LogLocator(subs=at))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
