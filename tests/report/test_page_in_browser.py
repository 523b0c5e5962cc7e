"""The page in a browser: its controls, its first screen, its contrast and width, and its print."""

import dataclasses
import html
import json
import re
import shutil
import subprocess

import numpy as np
import pytest

import sysid
from sysid.report import report

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed")
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--virtual-time-budget=4000")
ERRORS = """<script>
const errors = [];
window.onerror = (words) => errors.push(words);
for (const kind of ["error", "warn"]) console[kind] = (...words) => errors.push(words.join(" "));
</script>"""
# Every control is used; then the page is measured. What is scrolled sideways in a box of its own may be wider.
DRIVER = """<script>
const told = { errors, used: {} };
const count = (name) => { told.used[name] = (told.used[name] || 0) + 1; };
const paths = () => [...document.querySelectorAll(".area path.identified")].map((one) => one.getAttribute("d")).join();
for (const select of document.querySelectorAll("select")) {
  for (const option of [...select.options].reverse()) {
    const before = paths();
    select.value = option.value;
    select.dispatchEvent(new Event("change"));
    if (paths() !== before) count("select");
  }
}
const all = paths();
const area = document.querySelector(".area");
const box = area.getBoundingClientRect();
const point = (kind, share) => area.dispatchEvent(new PointerEvent(kind, { clientX: box.left + share * box.width,
  clientY: box.top + 50, bubbles: true, pointerType: "mouse" }));
point("pointermove", 0.5);
told.hover = document.querySelector(".told").textContent;
point("pointerdown", 0.3); point("pointermove", 0.6); point("pointerup", 0.6);
told.zoomed = paths() !== all;
area.dispatchEvent(new MouseEvent("dblclick"));
told.whole = paths() === all;
for (const button of document.querySelectorAll("button")) { button.click(); count(button.textContent); }
told.all_lines = paths() === all;
const keyed = document.querySelector(".told").textContent;
area.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
told.keys = document.querySelector(".told").textContent !== keyed;
for (const one of document.querySelectorAll("input[type=range]")) {
  one.value = 200;
  one.dispatchEvent(new Event("input"));
}
window.dispatchEvent(new Event("beforeprint"));
told.sheets = document.querySelectorAll(".paper svg").length;
window.dispatchEvent(new Event("afterprint"));
told.left = document.querySelectorAll(".paper").length;
const moving = () => [...document.querySelectorAll(".shapes circle")].map((one) => one.getAttribute("cx")).join();
told.over = [...document.querySelectorAll("body *")]
  .filter((one) => !one.closest(".scroll, pre, svg, [hidden], noscript"))
  .filter((one) => one.getBoundingClientRect().right > innerWidth + 1)
  .map((one) => one.outerHTML.slice(0, 80));
told.sideways = document.documentElement.scrollWidth - document.documentElement.clientWidth;
const bottom = (words) => [...document.querySelectorAll("strong, td, b")]
  .find((one) => one.textContent.startsWith(words)).getBoundingClientRect().bottom;
told.first = ["Determined", "Next:", "mode 1", "total mass"].map(bottom);
const light = (colour) => {
  const [r, g, b] = colour.match(/[0-9.]+/g).slice(0, 3).map((one) => one / 255)
    .map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const behind = (one) => {
  for (let at = one; at; at = at.parentElement) {
    const colour = getComputedStyle(at).backgroundColor;
    if (!colour.endsWith(", 0)") && colour !== "transparent") return colour;
  }
  return "rgb(255, 255, 255)";
};
const words = "p, td, th, li, a, h1, h2, strong, small, figcaption, button, svg text";
told.contrast = Math.min(...[...document.querySelectorAll(words)]
  .map((one) => {
    const style = getComputedStyle(one);
    const [a, b] = [light(one.closest("svg") ? style.fill : style.color), light(behind(one))].sort((x, y) => y - x);
    return (a + 0.05) / (b + 0.05);
  }));
told.paper = behind(document.body);
const begun = moving();
setTimeout(() => {
  told.moved = moving() !== begun;
  parent.postMessage(JSON.stringify(told), "*");
}, 700);
</script>"""


@pytest.fixture(scope="module")
def result(random_structure):
    truth = random_structure(np.random.default_rng(8), 3, 2, G=np.array([[1.0, 0.0], [0.6, 0.8], [0.0, 1.0]]))
    sensors = [sysid.Sensor(f"s{i}", (0, 0, i), axis) for i, axis in enumerate(("x", (0.6, 0.8, 0.0), "y"), 1)]
    test = sysid.simulate(truth, np.linspace(1.0, 120.0, 200), noise=0.01, force=True, rng=3)
    return sysid.identify(sysid.Problem(dataclasses.replace(test, sensors=sensors), mass=sysid.FullMass()), rng=0)


def measured(page, folder, width, height=800, *, dark=False):
    """Open the page in a frame of this size, use every control, and return what its script tells."""
    inner = re.sub(r"script-src '[^']*'", "script-src 'unsafe-inline'", page)
    inner = inner.replace("<style>", ERRORS + "<style>", 1).replace("</body>", DRIVER + "</body>")
    (folder / "page.html").write_text(inner, encoding="utf-8")
    (folder / "frame.html").write_text(
        f'<body style="margin:0"><iframe src="page.html" style="border:0" width={width} height={height}></iframe>'
        "<pre id=told></pre><script>onmessage = (e) => { told.textContent = e.data; };</script>"
    )
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    command = [CHROMIUM, *OPTIONS, scheme, "--window-size=1400,900", f"--user-data-dir={folder / 'user'}", "--dump-dom"]
    ran = subprocess.run(
        [*command, (folder / "frame.html").as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    (words,) = re.findall(r'<pre id="told">(.*?)</pre>', ran.stdout, re.DOTALL)
    assert words, ran.stderr
    return json.loads(html.unescape(words))


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (768, True), (380, False)])
def test_every_control_works_and_the_page_is_readable(result, tmp_path, width, dark):
    assert result.determined
    told = measured(report.render(result), tmp_path, width, dark=dark)
    assert told["errors"] == []
    assert told["used"]["select"] >= 4 and set(told["used"]) >= {"Zoom in", "Zoom out", "All lines", "Stop"}
    assert "Hz: measured" in told["hover"] and "noise" in told["hover"] and "95 % interval" in told["hover"]
    assert told["zoomed"] and told["whole"] and told["all_lines"] and told["keys"] and told["moved"]
    assert told["sheets"] == (3 + 2) * 2 and told["left"] == 0  # every channel of both runs, on paper alone
    assert told["over"] == [] and told["sideways"] <= 0
    assert max(told["first"]) < 800  # judgement, next step, masses and frequencies on the first screen
    assert told["contrast"] >= 4.5
    assert (sum(map(int, re.findall(r"\d+", told["paper"])[:3])) < 150) == dark


def test_the_page_prints(result, tmp_path):
    page, pdf = report.write_report(result, tmp_path), tmp_path / "page.pdf"
    command = [CHROMIUM, *OPTIONS, f"--user-data-dir={tmp_path / 'user'}", f"--print-to-pdf={pdf}", page.as_uri()]
    subprocess.run(command, capture_output=True, timeout=120, check=True)
    content = pdf.read_bytes()
    assert content.startswith(b"%PDF") and len(re.findall(rb"/Type\s*/Page\b", content)) > 2
