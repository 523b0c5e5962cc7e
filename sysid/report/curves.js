// Draws the curves and mode shapes of the page from the numbers that stand beside them, in place of its stills.
"use strict";

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 62, right: 12, top: 20, bottom: 30 };
const LEAST = 5; // lines that remain when zooming in
const DECADES = [1e5, 0, 1e4]; // at most, of the magnitude and of the difference
const DEGREES = 0.5; // steps of phases
const [LOWEST, HIGHEST] = [-270, 90]; // degrees: the step of a resonance, 0 to -180, is not cut

function element(parent, name, attributes = {}, words = "") {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = words;
  parent.append(made);
  return made;
}

function drawn(parent, name, attributes = {}, words = "") {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (words) made.textContent = words;
  parent.append(made);
  return made;
}

function numbers(packed) {
  return new Float32Array(Uint8Array.from(atob(packed), (letter) => letter.charCodeAt(0)).buffer);
}

// Whole numbers, each packed as its difference from the one before: twice its size, less one below zero, in groups of
// seven bits, the lowest first; a byte's eighth bit says that another follows.
function steps(packed) {
  const found = [];
  let [value, whole, place] = [0, 0, 1];
  for (const letter of atob(packed)) {
    const byte = letter.charCodeAt(0);
    whole += (byte & 127) * place;
    place *= 128;
    if (byte & 128) continue;
    value += whole % 2 ? -(whole + 1) / 2 : whole / 2;
    found.push(value);
    [whole, place] = [0, 1];
  }
  return found;
}

const sizes = ([least, step, packed]) => Float64Array.from(steps(packed), (k) => (k ? least * Math.exp((k - 1) * step) : 0));

function choice(parent, label, names) {
  const box = element(parent, "label", {}, label + " ");
  const select = element(box, "select");
  names.forEach((name, at) => element(select, "option", { value: at }, name));
  box.hidden = names.length < 2;
  return select;
}

function button(parent, words, action) {
  const made = element(parent, "button", { type: "button" }, words);
  made.addEventListener("click", action);
  return made;
}

const significant = (value, digits = 4) => (Number.isFinite(value) ? Number(value.toPrecision(digits)).toString() : "–");

// --- axes -----------------------------------------------------------------------------------------------------------

function ticksOf(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((one) => one >= rough);
  const ticks = [];
  for (let at = Math.ceil(low / step - 1e-9) * step; at <= high + 1e-9 * step; at += step) ticks.push(at);
  return ticks;
}

// Powers of ten, with their double and fivefold or their threefold as there is room, some left out where there is not.
function logTicks(low, high, room) {
  const decades = Math.log10(high / low);
  const every = Math.ceil(decades / room);
  const factors = [[1, 2, 5], [1, 3]].find((some) => some.length * decades <= room) || [1];
  const found = [];
  for (let power = Math.floor(Math.log10(low)); power <= Math.ceil(Math.log10(high)); power += 1) {
    for (const k of factors) {
      const tick = k * 10 ** power;
      if (tick >= low && tick <= high && power % every === 0) found.push(tick);
    }
  }
  return found;
}

function scale(low, high, from, to, log, wide) {
  const [a, b] = log ? [Math.log(low), Math.log(high)] : [low, high];
  const along = (value) => {
    const share = ((log ? Math.log(value) : value) - a) / (b - a);
    return from + Math.min(Math.max(share, 0), 1) * (to - from);
  };
  along.back = (pixel) => {
    const value = a + ((pixel - from) / (to - from)) * (b - a);
    return log ? Math.exp(value) : value;
  };
  const room = Math.abs(to - from) / wide;
  along.ticks = log && high >= 10 * low ? logTicks(low, high, room) : ticksOf(low, high, room);
  return along;
}

function line(x, y, freq, gaps, values, first, last, jump) {
  let path = "";
  let before = NaN;
  for (let at = first; at <= last; at += 1) {
    const up = Number.isFinite(values[at]) ? y(values[at]) : NaN;
    if (Number.isFinite(up)) path += `${Math.abs(up - before) <= jump && !gaps.includes(at) ? "L" : "M"}${x(freq[at]).toFixed(1)} ${up.toFixed(1)}`;
    before = up;
  }
  return path;
}

// One panel of curves: an array of {kind, values}, over the lines from `first` to `last`.
function panel(svg, top, height, width, x, { freq, gaps }, [first, last], curves, title, options) {
  const inner = [top + MARGIN.top, top + height - MARGIN.bottom];
  let [low, high] = [Infinity, -Infinity];
  for (const { kind, values } of curves) {
    if (kind === "band") continue; // it may leave the axis
    for (let at = first; at <= last; at += 1) {
      if (Number.isFinite(values[at]) && (!options.log || values[at] > 0)) {
        low = Math.min(low, values[at]);
        high = Math.max(high, values[at]);
      }
    }
  }
  if (options.range) [low, high] = options.range;
  if (high === -Infinity) {
    drawn(svg, "text", { x: (MARGIN.left + width) / 2, y: (inner[0] + inner[1]) / 2, "text-anchor": "middle" }, "0 at all lines");
  }
  if (!(high >= low)) [low, high] = options.log ? [(low || 1) / 2, (high || 1) * 2] : [low - 1, high + 1];
  if (options.log) [low, high] = [Math.max(low, high / options.log) / 1.3, high * 1.3];
  const y = scale(low, high, inner[1], inner[0], options.log, 18);
  const ticks = options.ticks || y.ticks;
  for (const tick of ticks) {
    drawn(svg, "line", { x1: MARGIN.left, x2: width - MARGIN.right, y1: y(tick), y2: y(tick), class: "grid" });
    drawn(svg, "text", { x: MARGIN.left - 6, y: y(tick) + 4, "text-anchor": "end" }, significant(tick));
  }
  for (const tick of x.ticks) {
    drawn(svg, "line", { x1: x(tick), x2: x(tick), y1: inner[0], y2: inner[1], class: "grid" });
    if (options.bottom) drawn(svg, "text", { x: x(tick), y: inner[1] + 16, "text-anchor": "middle" }, significant(tick));
  }
  drawn(svg, "text", { x: MARGIN.left, y: top + 13, class: "title" }, title);
  if (options.bottom) {
    drawn(svg, "text", { x: width - MARGIN.right, y: top + height - 2, "text-anchor": "end" }, "frequency [Hz]");
  }
  const jump = options.range ? Math.abs(inner[1] - inner[0]) / 2 : Infinity;
  for (const { kind, values: all } of curves) {
    const values = kind === "band" ? all.map((value) => (value < low || value > high ? NaN : value)) : all;
    drawn(svg, "path", { d: line(x, y, freq, gaps, values, first, last, jump), class: kind });
  }
}

// --- responses ------------------------------------------------------------------------------------------------------

function spectra(data, channel, run) {
  const phase = ([, turned]) => Float64Array.from(steps(turned), (k) => k * DEGREES);
  const level = (kind) => {
    const told = channel[kind] && sizes(channel[kind][run]);
    return told && told.length === 1 ? new Float64Array(left.length).fill(told[0]) : told;
  };
  const [measured, identified] = [channel.measured[run], channel.identified[run]];
  const left = sizes(channel.left[run]);
  return {
    measured: sizes(measured[0]), identified: sizes(identified[0]), phase: phase(measured), phaseIdentified: phase(identified),
    left, noise: level("noise"), recorded: level("recorded"), band: level("band"),
  };
}

function drawCurves(parent, { freq, gaps }, channel, values, [first, last], width, heights, recorded = false) {
  const total = heights.reduce((sum, one) => sum + one, 0);
  const svg = drawn(parent, "svg", { viewBox: `0 0 ${width} ${total}`, width, height: total, role: "img" });
  drawn(svg, "title", {}, `${channel.name}: measured and identified ${channel.words}`);
  const x = scale(freq[first], freq[last], MARGIN.left, width - MARGIN.right, freq[last] > 8 * freq[first] && freq[first] > 0, 40);
  const amplitude = [{ kind: "measured", values: values.measured }, { kind: "identified", values: values.identified }];
  if (recorded) amplitude.splice(1, 0, { kind: "recorded", values: values.recorded });
  const phase = [{ kind: "measured", values: values.phase }, { kind: "identified", values: values.phaseIdentified }];
  const left = [{ kind: "left", values: values.left }];
  for (const kind of ["noise", "band"]) if (values[kind]) left.push({ kind, values: values[kind] });
  const title = `${width < 600 ? "" : `${channel.name}: `}${channel.words} [${channel.unit}]`;
  panel(svg, 0, heights[0], width, x, { freq, gaps }, [first, last], amplitude, title, { log: DECADES[0] });
  const turns = { range: [LOWEST, HIGHEST], ticks: [-180, -90, 0] };
  panel(svg, heights[0], heights[1], width, x, { freq, gaps }, [first, last], phase, "phase [°]", turns);
  const below = { log: DECADES[2], bottom: true };
  const beside = `difference${values.noise ? " and noise" : ""} [${channel.unit}]`;
  panel(svg, heights[0] + heights[1], heights[2], width, x, { freq, gaps }, [first, last], left, beside, below);
  return { svg, x, total };
}

function startCurves(figure) {
  const data = JSON.parse(figure.querySelector("script").textContent);
  let freq = numbers(data.freq[0]);
  const legend = figure.querySelector(".legend");
  const bar = element(figure, "div", { class: "controls" });
  legend.before(bar);
  figure.classList.add("drawn"); // its stills remain for paper
  const channels = choice(bar, "Channel", data.channels.map((one) => one.name));
  const runs = choice(bar, "Run", data.runs);
  const withTransients = element(bar, "label", {}, "");
  const tick = element(withTransients, "input", { type: "checkbox" });
  withTransients.append(" as recorded, with transients");
  let range = [0, freq.length - 1];
  const zoomed = (factor) => () => {
    const middle = cursor === null ? (range[0] + range[1]) / 2 : cursor;
    const half = Math.max((factor * (range[1] - range[0])) / 2, LEAST / 2);
    range = [Math.max(0, Math.floor(middle - half)), Math.min(freq.length - 1, Math.ceil(middle + half))];
    redraw();
  };
  button(bar, "Zoom in", zoomed(0.5));
  button(bar, "Zoom out", zoomed(2));
  button(bar, "All lines", () => {
    range = [0, freq.length - 1];
    redraw();
  });
  const area = element(figure, "div", { class: "area", tabindex: 0 });
  area.setAttribute("aria-label", "Curves: arrow keys move the cursor from line to line");
  const told = element(figure, "p", { class: "told", role: "status" });
  let [cursor, view, values, held] = [null, null, null, null];

  function tell() {
    if (cursor === null || cursor < range[0] || cursor > range[1]) cursor = null;
    view.mark?.remove();
    if (cursor === null) {
      told.textContent = "Point at the curves for values; drag across them to zoom, double click for all lines.";
      return;
    }
    const at = view.x(freq[cursor]);
    view.mark = drawn(view.svg, "line", { x1: at, x2: at, y1: MARGIN.top, y2: view.total - MARGIN.bottom, class: "cursor" });
    const noise = values.noise ? `, noise ${significant(values.noise[cursor], 3)}` : "";
    const band = values.band ? `, 95 % interval ± ${significant(values.band[cursor], 3)}` : "";
    told.textContent =
      `${significant(freq[cursor])} Hz: measured ${significant(values.measured[cursor], 3)} at ` +
      `${values.phase[cursor].toFixed(0)}°, identified ${significant(values.identified[cursor], 3)} at ` +
      `${values.phaseIdentified[cursor].toFixed(0)}°, difference ${significant(values.left[cursor], 2)}${noise}${band}`;
  }

  // Runs of other lengths have other lines: the same frequencies stay in sight.
  function changeRun() {
    const [low, high] = range.map((at) => freq[at]);
    freq = numbers(data.freq[runs.value]);
    const nearest = (wanted) => freq.reduce((best, one, at) => (Math.abs(one - wanted) < Math.abs(freq[best] - wanted) ? at : best), 0);
    range = [nearest(low), nearest(high)];
    cursor = null;
  }

  function redraw() {
    const channel = data.channels[channels.value];
    values = spectra(data, channel, runs.value);
    withTransients.hidden = !values.recorded;
    legend.querySelector(".recorded")?.toggleAttribute("hidden", !(tick.checked && values.recorded));
    for (const kind of ["noise", "band"]) legend.querySelector(`.${kind}`)?.toggleAttribute("hidden", !values[kind]);
    area.replaceChildren();
    const width = Math.max(300, Math.min(1200, area.clientWidth));
    view = drawCurves(area, { freq, gaps: data.gaps[runs.value] }, channel, values, range, width, [230, 120, 150], tick.checked && values.recorded);
    tell();
  }

  function lineAt(event) {
    const box = view.svg.getBoundingClientRect();
    const wanted = view.x.back(((event.clientX - box.left) / box.width) * view.svg.viewBox.baseVal.width);
    let best = range[0];
    for (let at = range[0]; at <= range[1]; at += 1) if (Math.abs(freq[at] - wanted) < Math.abs(freq[best] - wanted)) best = at;
    return best;
  }

  area.addEventListener("pointermove", (event) => {
    cursor = lineAt(event);
    tell();
    view.zoom?.remove();
    if (held === null) return;
    const ends = [view.x(freq[held]), view.x(freq[cursor])].sort((a, b) => a - b);
    view.zoom = drawn(view.svg, "rect", { x: ends[0], width: ends[1] - ends[0], y: 0, height: view.total, class: "zoom" });
  });
  area.addEventListener("pointerdown", (event) => {
    if (event.pointerType !== "touch") held = lineAt(event);
  });
  window.addEventListener("pointerup", (event) => {
    if (held === null) return;
    const ends = [held, lineAt(event)].sort((a, b) => a - b);
    held = null;
    if (ends[1] - ends[0] >= LEAST) range = ends;
    redraw();
  });
  area.addEventListener("dblclick", () => {
    range = [0, freq.length - 1];
    redraw();
  });
  area.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!step) return;
    event.preventDefault();
    cursor = Math.max(range[0], Math.min(range[1], (cursor ?? range[0] - step) + step));
    tell();
  });
  runs.addEventListener("change", changeRun);
  for (const control of [channels, runs, tick]) control.addEventListener("change", redraw);
  window.addEventListener("resize", redraw);
  redraw();
}

// --- mode shapes ----------------------------------------------------------------------------------------------------

// What the eye sees of a point from an angle about the vertical, slightly from above: to the right, and down.
function seen([x, y, z], angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  return [c * x - s * y, -0.95 * z + 0.3 * (s * x + c * y)];
}

function middleOf(data) {
  return [0, 1, 2].map((i) => {
    const own = data.points.map((point) => point[i]);
    return (Math.min(...own) + Math.max(...own)) / 2;
  });
}

function drawMode(parent, data, mode, width, height) {
  const svg = drawn(parent, "svg", { viewBox: `0 0 ${width} ${height}`, width, height, role: "img" });
  drawn(svg, "title", {}, data.names[mode]);
  const middle = middleOf(data);
  const from = (point) => point.map((v, i) => v - middle[i]);
  const every = data.shapes.flatMap((shape) => data.points.map((point, p) => from(point).map((v, i) => Math.abs(v) + Math.abs(shape[p][i]))));
  const wide = Math.max(...every.map(([x, y]) => Math.hypot(x, y)));
  const high = Math.max(...every.map((point) => point[2]));
  const size = Math.min((width - 40) / (2 * wide || 1), (height - 60) / (1.9 * high + 0.6 * wide || 1));
  const place = (point, angle) => {
    const [x, y] = seen(from(point), angle);
    return [width / 2 + size * x, (height + 30) / 2 + size * y];
  };
  const stick = (kind) => data.sticks.map(() => drawn(svg, "line", { class: kind }));
  const points = (kind) => data.points.map((_, p) => drawn(svg, "circle", { r: p ? 3 : 0, class: kind }));
  const [rest, still, moved, dots] = [stick("rest"), points("place"), stick("identified"), points("dot")];
  const base = drawn(svg, "rect", { width: 44, height: 6, class: "base" });
  const named = drawn(svg, "text", {}, "base");
  data.names[mode].split(", ").forEach((words, at) => {
    drawn(svg, "text", { x: width / 2, y: 13 + 14 * at, "text-anchor": "middle", class: at ? "" : "title" }, words);
  });
  const put = (one, values) => Object.entries(values).forEach(([key, value]) => one.setAttribute(key, value));
  const join = (lines, places) => lines.forEach((one, at) => {
    const [start, end] = data.sticks[at].map((p) => places[p]);
    put(one, { x1: start[0], y1: start[1], x2: end[0], y2: end[1] });
  });
  return (share, angle) => {
    const at = data.points.map((point) => place(point, angle));
    join(rest, at);
    still.forEach((dot, p) => put(dot, { cx: at[p][0], cy: at[p][1] }));
    const places = data.points.map((point, p) => place(point.map((v, i) => v + share * data.shapes[mode][p][i]), angle));
    join(moved, places);
    dots.forEach((dot, p) => put(dot, { cx: places[p][0], cy: places[p][1] }));
    const [x, y] = at[0];
    put(base, { x: x - 22, y: y - 3 });
    put(named, { x: x + 26, y: y + 5 });
  };
}

function startModes(figure) {
  const data = JSON.parse(figure.querySelector("script").textContent);
  figure.querySelector(".shapes").remove();
  const bar = element(figure, "div", { class: "controls" });
  const area = element(figure, "div", { class: "shapes" });
  const moves = data.names.map((_, mode) => drawMode(area, data, mode, 210, 260));
  let [running, begun] = [false, 0];
  const play = button(bar, "Move", () => {
    running = !running;
    play.textContent = running ? "Stop" : "Move";
    begun = performance.now();
    if (running) requestAnimationFrame(step);
    else draw(1);
  });
  const turn = element(element(bar, "label", {}, "View from "), "input", { type: "range", min: 0, max: 360, value: 30 });
  const draw = (share) => moves.forEach((move) => move(share, (turn.value * Math.PI) / 180));
  turn.addEventListener("input", () => running || draw(1));
  function step(now) {
    if (!running) return;
    draw(Math.cos((now - begun) / 250));
    requestAnimationFrame(step);
  }
  draw(1);
}

document.querySelectorAll("figure.modes").forEach(startModes);
document.querySelectorAll("figure.curves").forEach(startCurves);
