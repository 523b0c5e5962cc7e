"""Pictures: they show the arrays that they say, need no display, and leave nothing open."""

import dataclasses
import itertools
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.stats import norm

import sysid
from sysid import plot
from sysid.finding import Finding, Severity
from sysid.modal_analysis.stabilisation import LEVELS, cmif, stabilisation
from sysid.modal_analysis.stretches import Stretch
from sysid.plot.canvas import new_figure, to_png
from sysid.plot.panels import draw, draw_law, key, response_channel, strongest
from sysid.structure.amplitude import FittedLaw, LawForm

FREQ = np.linspace(1.0, 40.0, 60)


@pytest.fixture
def truth(random_structure):
    return random_structure(np.random.default_rng(8), 3, 2, G=np.array([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]))


@pytest.fixture
def guess(truth):
    """The truth with a stiffness 3 % off."""
    return sysid.Structure(truth.mass, 1.03 * truth.stiffness, truth.damping_ratios, n_base=2)


def result(structure, test, *, goal=None, validation=(), **history):
    """Stand in for what `identify` gives."""
    problem = sysid.Problem(
        test,
        mass=sysid.FullMass(),
        stiffness=sysid.SpectralStiffness(structure.natural_frequencies),
        goal=goal,
        validation=validation,
    )
    x = problem.values(structure)
    return sysid.Identification(
        structure, problem, x, "swarm", 0, sysid.History(**history), (Finding("open", Severity.CAUTION, "all is open"),)
    )


@pytest.fixture
def unit(truth, guess):
    sensors = [
        sysid.Sensor("low", (0, 0, 1.0), "x"),
        sysid.Sensor("$middle_", (0, 0, 2.0), (0.6, 0.8, 0.0)),
        sysid.Sensor("tip", (0, 0, 3.0), "y"),
    ]
    test = sysid.simulate(truth, FREQ, noise=0.01, force=True, rng=3)
    test = dataclasses.replace(test, sensors=sensors)
    return result(
        guess,
        test,
        start=0.9,
        swarm=0.5,
        local=0.01,
        swarm_curve=np.array([0.9, 0.7, 0.5]),
        local_curve=np.array([0.4, 0.1, 0.02, 0.01]),
    )


@pytest.fixture
def runs(truth, guess):
    """Two runs in which both base directions move."""
    random = np.random.default_rng(4)
    base = random.standard_normal((2, 2, FREQ.size)) + 1j * random.standard_normal((2, 2, FREQ.size))
    base[1, 0] *= 5
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(FREQ), base)
    force = np.einsum("edf,rdf->ref", truth.base_force(FREQ), base)
    return result(guess, sysid.Measurement(FREQ, base, response, rigid_body=truth.rigid_body, force=force))


def lines(ax):
    return {line.get_label(): line for line in ax.get_lines()}


def kept(line):
    """Data of a curve without the breaks at its wraps."""
    return line.get_ydata()[~np.isnan(line.get_ydata())]


def test_transmissibility_shows_measured_and_identified_magnitude_and_phase(unit, guess):
    figure = plot.transmissibility(unit, sensor="tip", run="x")
    magnitude, phase = figure.axes
    measured, identified = unit.measurement.response[0, 2], guess.transmissibility(FREQ)[2, 0]
    np.testing.assert_array_equal(lines(magnitude)["measured"].get_xdata(), FREQ)
    np.testing.assert_array_equal(lines(magnitude)["measured"].get_ydata(), np.abs(measured))
    np.testing.assert_allclose(lines(magnitude)["identified"].get_ydata(), np.abs(identified), rtol=1e-9)
    np.testing.assert_allclose(lines(magnitude)["difference"].get_ydata(), np.abs(identified - measured), rtol=1e-7)
    np.testing.assert_allclose(kept(lines(phase)["measured"]), np.angle(measured, deg=True))
    np.testing.assert_allclose(kept(lines(phase)["identified"]), np.angle(identified, deg=True), atol=1e-9)
    assert magnitude.get_title() == "tip, base x"
    assert magnitude.get_ylabel() == "transmissibility [–]" and phase.get_ylabel() == "phase [°]"
    assert phase.get_xlabel() == "frequency [Hz]"


def test_runs_that_are_not_unit_runs_are_called_spectra(runs, guess):
    magnitude, phase = plot.transmissibility(runs, sensor=1, run=1).axes
    test = runs.measurement
    identified = np.einsum("df,df->f", guess.transmissibility(FREQ)[1], test.base[1])
    np.testing.assert_allclose(lines(magnitude)["identified"].get_ydata(), np.abs(identified), rtol=1e-9)
    np.testing.assert_allclose(
        kept(lines(phase)["measured"]), np.angle(test.response[1, 1] / test.base[1, 0], deg=True), atol=1e-9
    )
    assert magnitude.get_title() == "sensor 2, run 2"
    assert "spectrum\n[m/s²" in magnitude.get_ylabel() and "transmissibility" not in magnitude.get_ylabel()
    assert phase.get_ylabel() == "phase to\nbase x [°]"


def test_axes_that_are_given_are_drawn_into_and_returned(unit):
    figure = Figure()
    above, below = figure.subplots(2, 1)
    assert plot.transmissibility(unit, above) is above
    assert lines(above) and not lines(below) and above.get_xlabel() == "frequency [Hz]"
    pair = figure.subplots(2, 1)
    assert plot.transmissibility(unit, pair) is pair
    assert all(lines(ax) for ax in pair)
    for picture in (plot.convergence, plot.mac, plot.effective_masses, plot.stabilisation, plot.cmif):
        ax = figure.add_subplot()
        assert picture(unit, ax) is ax


def test_the_default_channel_is_the_strongest(unit):
    energy = np.linalg.norm(unit.measurement.relative, axis=-1)
    run, sensor = np.unravel_index(np.argmax(energy), energy.shape)
    title = plot.transmissibility(unit).axes[0].get_title()
    assert title == f"{unit.measurement.sensor_names[sensor]}, base {'xy'[run]}"
    chosen = strongest(unit.measurement, 3)
    assert sorted(s for s, _ in chosen) == [0, 1, 2]


def test_base_force_shows_the_apparent_mass(unit, guess):
    magnitude = plot.base_force(unit, direction="y", run="x").axes[0]
    np.testing.assert_array_equal(lines(magnitude)["measured"].get_ydata(), np.abs(unit.measurement.force[0, 1]))
    np.testing.assert_allclose(
        lines(magnitude)["identified"].get_ydata(), np.abs(guess.base_force(FREQ)[1, 0]), rtol=1e-10
    )
    assert magnitude.get_ylabel() == "apparent mass [kg]"
    assert len(plot.base_forces(unit, 0).axes) == 4


def test_moments_have_their_units(random_structure):
    G = np.array([[1.0, 2.0], [1.0, 4.0], [1.0, 7.0]])
    truth = random_structure(np.random.default_rng(2), 3, 2, G=G)
    it = result(truth, sysid.simulate(truth, FREQ, force=True, base_axes=["x", "ry"]))
    labels = [[plot.base_force(it, direction=i, run=r).axes[0].get_ylabel() for r in ("x", "ry")] for i in ("x", "ry")]
    assert labels == [["apparent mass [kg]", "apparent mass [kg m]"], ["apparent mass [kg m]", "apparent mass [kg m²]"]]
    assert plot.base_force(it, direction="ry", run="x").axes[0].get_title() == "moment about y, base x"
    assert plot.transmissibility(it, run="ry").axes[0].get_ylabel() == "transmissibility [m]"


def test_responses_have_a_panel_a_run_however_many(truth, guess):
    random = np.random.default_rng(1)
    base = random.standard_normal((5, 2, FREQ.size)) + 0j
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(FREQ), base)
    it = result(guess, sysid.Measurement(FREQ, base, response, rigid_body=truth.rigid_body))
    figure = plot.responses(it, 0)
    assert [ax.get_title() for ax in figure.axes if ax.get_title()] == [f"sensor 1, run {r + 1}" for r in range(5)]


def test_convergence_joins_both_curves(unit):
    ax = plot.convergence(unit).axes[0]
    swarm, local = (lines(ax)[name] for name in ("swarm (best so far)", "local phase"))
    np.testing.assert_array_equal(swarm.get_ydata(), [0.9, 0.7, 0.5])
    np.testing.assert_array_equal(local.get_xdata(), [2, 3, 4, 5])
    np.testing.assert_array_equal(local.get_ydata(), [0.4, 0.1, 0.02, 0.01])
    assert ax.get_yscale() == "log" and ax.get_ylabel() == "objective [–]"


def test_convergence_without_a_swarm_marks_each_iterate(unit):
    history = sysid.History(start=0.3, local=0.3 * (1 - 1e-9), local_curve=np.array([0.3, 0.3 * (1 - 1e-9)]))
    ax = plot.convergence(dataclasses.replace(unit, history=history)).axes[0]
    (curve,) = ax.get_lines()
    np.testing.assert_array_equal(curve.get_xdata(), [0, 1])
    assert curve.get_marker() == "o" and ax.get_xlabel() == "iteration"
    low, high = ax.get_ylim()  # wide enough for a plain number, and for a fall of nothing to look like one
    assert low < 0.2 < 0.3 < high
    single = sysid.History(start=0.3, local=0.3, local_curve=np.array([0.3]))
    assert plot.convergence(dataclasses.replace(unit, history=single)).axes[0].get_xlim() == (-0.5, 1.5)


def test_convergence_tells_widened_peaks_from_the_records(unit):
    history = dataclasses.replace(unit.history, start=np.nan)
    swarm, local, *_ = plot.convergence(dataclasses.replace(unit, history=history)).axes[0].lines
    assert (swarm.get_label(), swarm.get_linestyle()) == ("swarm, of widened peaks", "--")
    assert (local.get_label(), local.get_linestyle()) == ("local phase, of the records", "-")


def test_convergence_without_a_search_says_so(runs):
    ax = plot.convergence(runs).axes[0]
    assert [text.get_text() for text in ax.texts] == ["no search is recorded"]


def test_mac_and_matrices_show_the_matrices(unit, guess):
    figure = plot.mac(unit)
    np.testing.assert_array_equal(figure.axes[0].images[0].get_array(), unit.mac)
    assert figure.axes[0].get_title() == "AutoMAC"
    against = dataclasses.replace(unit, problem=dataclasses.replace(unit.problem, reference=guess))
    assert plot.mac(against).axes[0].get_title() == "MAC against the reference"
    shown = [ax.images[0].get_array() for ax in plot.matrices(unit).axes[:3]]
    for image, matrix in zip(shown, (guess.mass[:3, :3], guess.stiffness[:3, :3], guess.damping), strict=True):
        np.testing.assert_allclose(np.diag(image), 1)
        np.testing.assert_allclose(image[0, 1], matrix[0, 1] / np.sqrt(matrix[0, 0] * matrix[1, 1]))


def test_effective_masses_are_shares_of_the_rigid_body_mass(unit, guess):
    ax = plot.effective_masses(unit).axes[0]
    bars = np.reshape([bar.get_height() for bar in ax.patches], (2, 3))
    expected = 100 * guess.participation.T**2 / np.diag(guess.rigid_body_mass)[:, None]
    np.testing.assert_allclose(bars, expected)
    np.testing.assert_allclose(ax.get_lines()[1].get_ydata(), np.cumsum(expected[1]))


def test_no_legend_of_effective_masses_covers_them(unit):
    figure = plot.effective_masses(unit)
    to_png(figure)
    (ax,) = figure.axes
    legend = ax.get_legend().get_tightbbox()
    assert legend.y0 >= 0 and legend.y1 < ax.get_window_extent().y0


def test_mode_shapes_stand_on_the_base_and_no_label_is_cut(unit):
    figure = plot.mode_shapes(unit)
    to_png(figure)
    for ax in figure.axes:
        drawn = np.hstack([line.get_data_3d() for line in ax.get_lines()])
        assert np.sum(np.all(drawn == 0, axis=0)) == 2  # at rest and moved
        for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
            seen = axis.label.get_window_extent()
            assert min(seen.x0, seen.y0) >= 0 and seen.x1 <= figure.bbox.x1 and seen.y1 <= figure.bbox.y1


def test_a_label_that_differs_from_its_neighbours_stands_in_a_gap_of_its_own(truth, guess):
    base = np.einsum("rd,f->rdf", [[1.0, 0.1], [0.1, 1.0], [1.0, 0.2]], np.ones(FREQ.size, complex))
    response = np.einsum("sdf,rdf->rsf", truth.transmissibility(FREQ), base)
    it = result(guess, sysid.Measurement(FREQ, base, response, rigid_body=truth.rigid_body, base_axes="xy"))
    figure = plot.responses(it, 0)
    to_png(figure)
    phases = figure.axes[1::2]
    assert [ax.get_ylabel() for ax in phases] == [f"phase to\nbase {axis} [°]" for axis in "xyx"]
    for left, right in itertools.pairwise(phases):
        assert right.yaxis.label.get_window_extent().x0 > left.get_window_extent().x1
    shown = [ax.get_ylabel() for ax in plot.overview(it).subfigs[0].axes]
    assert [label.count("phase") for label in shown].count(1) >= 2


def test_mode_shapes_need_positions(unit, runs):
    figure = plot.mode_shapes(unit, [1, 3])
    assert [ax.get_title().split(":")[0] for ax in figure.axes] == ["mode 1", "mode 3"]
    with pytest.raises(sysid.InputError, match="not described"):
        plot.mode_shapes(runs)
    with pytest.raises(sysid.InputError, match="modes 1 to 3"):
        plot.mode_shapes(unit, [0])


def modes_drawn(ax, label):
    """Where vertical lines stand, of which the first carries the label."""
    upright = [line for line in ax.get_lines() if len(line.get_xdata()) == 2 and np.ptp(line.get_xdata()) == 0]
    assert upright[0].get_label() == label
    return [line.get_xdata()[0] for line in upright]


def test_the_stabilisation_diagram_shows_every_pole_before_the_singular_value(unit, guess):
    figure = plot.stabilisation(unit)
    ax, behind = figure.axes
    diagram = stabilisation(unit.measurement)
    names = ["new pole", *(f"stable: {what}" for what in LEVELS[1:])]
    for level, name in enumerate(names):
        shown = lines(ax)[name]
        np.testing.assert_array_equal(shown.get_xdata(), diagram.frequency[diagram.stable == level])
        np.testing.assert_array_equal(shown.get_ydata(), diagram.order[diagram.stable == level])
    (curve,) = behind.get_lines()
    np.testing.assert_array_equal(curve.get_ydata(), cmif(unit.measurement)[0])
    f = guess.natural_frequencies
    np.testing.assert_array_equal(modes_drawn(ax, "identified mode"), f[f < FREQ[-1]])
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("frequency [Hz]", "order [modes]")
    assert behind.get_ylabel() == "largest singular value [–]"
    told = [text.get_text() for text in ax.get_legend().get_texts()]
    assert told == [*reversed(names), "identified mode"]


@pytest.mark.parametrize("size", [(6.4, 4.2), (5.6, 4.2)])
def test_labels_of_both_axes_of_the_stabilisation_diagram_are_within_the_picture(unit, runs, size):
    one = sysid.Measurement(FREQ, runs.measurement.base[:1], runs.measurement.response[:1], rigid_body=np.eye(3, 2))
    for subject in (unit, one):  # a label of one line, and of two, with a remark
        figure = plot.stabilisation(subject)
        figure.set_size_inches(*size)
        to_png(figure)
        for ax in figure.axes:
            seen = ax.get_tightbbox()
            assert min(seen.x0, seen.y0) >= 0 and seen.x1 <= figure.bbox.x1 and seen.y1 <= figure.bbox.y1


def test_the_cmif_shows_every_singular_value(unit, truth):
    ax = plot.cmif(unit.measurement).axes[0]
    first, second = cmif(unit.measurement)
    np.testing.assert_array_equal(lines(ax)["first"].get_ydata(), first)
    np.testing.assert_array_equal(lines(ax)["second"].get_ydata(), second)
    assert (ax.get_xlabel(), ax.get_ylabel(), ax.get_yscale()) == ("frequency [Hz]", "singular value [–]", "log")
    found = modes_drawn(ax, "vector fitting")
    assert np.abs(np.array(found)[:, None] / truth.natural_frequencies - 1).min(axis=1).max() < 0.05


def test_without_an_frf_the_pictures_of_the_modes_say_so(runs):
    test = runs.measurement
    one = sysid.Measurement(FREQ, test.base[:1], test.response[:1], rigid_body=test.rigid_body)
    alone = dataclasses.replace(runs, problem=dataclasses.replace(runs.problem, measurement=one))
    ax, behind = plot.stabilisation(alone).axes
    (curve,) = behind.get_lines()
    np.testing.assert_allclose(curve.get_ydata(), np.linalg.norm(one.relative[0], axis=0))
    assert "new pole" not in lines(ax) and lines(ax)["identified mode"]
    with pytest.raises(sysid.InputError, match="the one run does not move the base") as refused:
        stabilisation(one)
    assert str(refused.value) in ax.texts[0].get_text().replace("\n", " ")
    ax = plot.cmif(alone).axes[0]
    np.testing.assert_allclose(lines(ax)["first"].get_ydata(), curve.get_ydata())
    assert ax.texts[0].get_text().startswith("Singular values of the runs' own spectra: the one run")
    assert ax.get_ylabel() == "singular value\n[m/s², own scale]"


def test_the_cmif_of_more_than_six_runs_shows_six_singular_values():
    """Two base directions, one of which never moves: there is no FRF, and eight runs have eight singular values."""
    rng = np.random.default_rng(0)
    base = np.zeros((8, 2, FREQ.size), complex)
    base[:, 0] = 1.0
    response = rng.standard_normal((8, 8, FREQ.size)) + 0j
    test = sysid.Measurement(FREQ, base, response, rigid_body=np.eye(2)[[0] * 8])
    expected = np.linalg.svd((response - 1.0).transpose(2, 0, 1), compute_uv=False)[:, 5]
    np.testing.assert_allclose(lines(plot.cmif(test).axes[0])["sixth"].get_ydata(), expected)


def test_runs_alone_at_their_lines_have_one_singular_value(runs):
    rng = np.random.default_rng(0)
    records = [(rng.standard_normal((2, n)), rng.standard_normal((3, n)), None) for n in (400, 300)]
    test = sysid.Measurement.from_time(records, 100.0, rigid_body=runs.measurement.rigid_body, band=(1.0, 10.0))
    drawn = lines(plot.cmif(test).axes[0])
    assert "first" in drawn and "second" not in drawn


def test_a_band_is_the_interval_of_the_identified_magnitude(unit, runs):
    std = 0.01 * (1 + np.random.default_rng(0).random((3, 2, FREQ.size)))
    for it, expected in (
        (unit, std[1, 1]),
        (runs, np.abs(runs.measurement.base[1, 0]) * std[1, 0] + np.abs(runs.measurement.base[1, 1]) * std[1, 1]),
    ):
        channel = response_channel(it, it.measurement, 1, 1, band=std)
        ax = Figure().subplots()
        draw([ax], channel)
        edges = ax.collections[0].get_paths()[0].vertices
        size = np.abs(channel.identified)
        for line, middle, reach in zip(FREQ, size, norm.ppf(0.975) * expected, strict=True):
            low, high = np.sort(edges[edges[:, 0] == line, 1])[[0, -1]]
            assert high == pytest.approx(middle + reach)
            assert low == pytest.approx(max(middle - reach, 1e-3 * middle))
        assert [entry.get_label() for entry in key([ax])] == ["measured", "identified", "95 % band", "difference"]


def test_a_run_of_another_length_shows_its_own_lines_only(runs):
    """Two records of 400 and 300 samples at 100 Hz: lines of the second are 1/3 Hz apart, zeros stand between."""
    rng = np.random.default_rng(0)
    records = [(rng.standard_normal((2, n)), rng.standard_normal((3, n)), None) for n in (400, 300)]
    test = sysid.Measurement.from_time(records, 100.0, rigid_body=runs.measurement.rigid_body, band=(1.0, 10.0))
    channel = response_channel(runs, test, 1, 1)
    np.testing.assert_allclose(channel.freq, np.arange(3, 31) / 3)
    assert test.freq.size > channel.freq.size == channel.measured.size == channel.identified.size == channel.std.size
    assert np.all(channel.measured != 0) and np.all(channel.identified != 0)


def test_every_picture_of_responses_takes_a_band(unit):
    u = unit.uncertainty
    of_responses, of_force = u.transmissibility(FREQ), u.base_force(FREQ)
    for figure in (
        plot.transmissibility(unit, sensor=1, run=1, band=of_responses),
        plot.responses(unit, 1, band=of_responses),
        plot.base_force(unit, direction=1, run=1, band=of_force),
        plot.base_forces(unit, 1, band=of_force),
    ):
        std = of_responses[1, 1] if "transmissibility" in figure.axes[0].get_ylabel() else of_force[1, 1]
        shade = figure.axes[2 if len(figure.axes) == 4 else 0]
        size = lines(shade)["identified"].get_ydata()
        top = shade.collections[0].get_paths()[0].vertices
        at = int(np.argmax(std))
        assert top[top[:, 0] == FREQ[at], 1].max() == pytest.approx(size[at] + norm.ppf(0.975) * std[at])
    assert not plot.transmissibility(unit, sensor=1, run=1).axes[0].collections
    with pytest.raises(sysid.InputError, match=r"band has shape \(3, 2, 59\); .* are \(3, 2, 60\)"):
        plot.responses(unit, 0, band=of_responses[..., 1:])
    with pytest.raises(sysid.InputError, match=r"are \(2, 2, 60\)"):
        plot.base_force(unit, band=of_responses)


def test_a_band_that_is_not_known_leaves_a_gap(unit):
    band = np.full((3, 2, FREQ.size), np.nan)
    assert not plot.transmissibility(unit, band=band).axes[0].collections
    band[..., :20] = 0.1
    (shade,) = plot.transmissibility(unit, band=band).axes[0].collections
    assert shade.get_paths()[0].vertices[:, 0].max() == FREQ[19]


def test_what_is_not_there_is_refused(unit):
    with pytest.raises(sysid.InputError, match="sensor 'nose' is unknown"):
        plot.transmissibility(unit, sensor="nose")
    with pytest.raises(sysid.InputError, match="run 2 is out of range: there are 2, counted from 0"):
        plot.transmissibility(unit, run=2)
    silent = dataclasses.replace(unit.measurement, force=None, force_std=None)
    with pytest.raises(sysid.InputError, match="no base force"):
        plot.base_force(unit, measurement=silent)


@pytest.fixture(params=["runs", "one line", "three lines from zero"])
def drawable(request, truth):
    """Results of which pictures are drawn: many lines, and hardly any."""
    few = {"one line": [5.0], "three lines from zero": [0.0, 5.0, 10.0]}
    if request.param in few:
        test = sysid.simulate(truth, few[request.param])
        return result(truth, test, goal=1e-6, swarm_curve=np.array([0.5]), swarm=0.5)
    return request.getfixturevalue(request.param)


def test_every_picture_is_drawn_without_a_warning(drawable):
    pictures = [plot.overview, plot.transmissibility, plot.convergence, plot.mac, plot.effective_masses]
    for picture in (*pictures, plot.stabilisation, plot.cmif):
        assert to_png(picture(drawable), dpi=40).startswith(b"\x89PNG")


def test_pictures_of_the_poles_are_drawn_of_a_measurement_the_search_and_shapes_in_few_colours(unit):
    for picture in (plot.stabilisation, plot.cmif):
        assert to_png(picture(unit.measurement), dpi=40).startswith(b"\x89PNG")
    assert to_png(plot.convergence(unit), dpi=40).startswith(b"\x89PNG")
    assert to_png(plot.mode_shapes(unit), dpi=40, colours=16).startswith(b"\x89PNG")


def test_a_response_of_round_off_is_called_that(truth):
    test = sysid.simulate(truth, FREQ)
    quiet = test.response.copy()
    quiet[1, 0] = 1e-17
    it = result(truth, dataclasses.replace(test, response=quiet))
    texts = plot.transmissibility(it, sensor=0, run="y").axes[0].texts
    assert [text.get_text() for text in texts] == ["round-off: no response"]


def test_the_overview_is_1200_pixels_wide(unit):
    png = to_png(plot.overview(unit))
    assert int.from_bytes(png[16:20], "big") == 1200


def test_a_notebook_can_show_a_figure_without_pyplot(unit):
    assert plot.convergence(unit)._repr_png_().startswith(b"\x89PNG")


def test_importing_draws_in_neither_matplotlib_nor_a_display():
    code = "import sys, sysid.plot, sysid.report; sys.exit('matplotlib' in sys.modules or 'h5py' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_law_of_amplitude_is_drawn_for_each_mode_that_has_one_and_else_refused(unit):
    levels = np.geomspace(1.0, 8.0, 4)
    low, high = LawForm(0.5, 1.0, 10.0), LawForm(1.0, 1.0, 10.0)
    laws = [
        FittedLaw(f, 0.01, 0, form, np.array([0.1, 0.02]), (1.0, 8.0), 1e-8 * np.eye(4), True)
        for f, form in ((3.0, low), (8.0, high))
    ]
    axes = new_figure(8.0, 6.0).subplots(2, 2)
    for row, law in zip(axes, laws, strict=True):
        f, zeta = np.array([law.at(level) for level in levels]).T
        rms, size = levels / np.sqrt(2), np.full(1, 1e-3)
        seen = [
            Stretch(0, 0.0, 1.0, f[i : i + 1], size, zeta[i : i + 1], size, rms[i : i + 1], 0.0, 0.0) for i in range(4)
        ]
        draw_law(row, law, seen)
        for ax, expected in zip(row, (f, 100 * zeta), strict=True):
            curve, points = ax.get_lines()[:2]
            np.testing.assert_allclose(points.get_data(), (levels, expected))
            drawn = np.interp(np.log(levels), np.log(curve.get_xdata()), curve.get_ydata())
            np.testing.assert_allclose(drawn, expected, rtol=1e-4)
    with pytest.raises(sysid.InputError, match="amplitude"):
        plot.amplitude(unit)
