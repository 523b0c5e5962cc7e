"""A page in headless Chromium, without network: every control used by a script of its own, then measured."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
OPTIONS = ("--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--virtual-time-budget=4000")
ERRORS = """<script>
const errors = [];
window.onerror = (words) => errors.push(words);
for (const kind of ["error", "warn"]) console[kind] = (...words) => errors.push(words.join(" "));
</script>"""
# Every control is used; then the page is measured. A table that is scrolled sideways in a box of its own may be wider.
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
for (const tick of document.querySelectorAll("input[type=checkbox]")) {
  const recorded = () => document.querySelectorAll("path.recorded").length;
  const before = recorded();
  tick.click();
  if (recorded() > before) count("checkbox");
}
for (const button of document.querySelectorAll("button")) { button.click(); count(button.textContent); }
told.all_lines = paths() === all;
const keyed = document.querySelector(".told").textContent;
area.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowRight" }));
told.keys = document.querySelector(".told").textContent !== keyed;
for (const one of document.querySelectorAll("input[type=range]")) {
  one.value = 200;
  one.dispatchEvent(new Event("input"));
}
const sheets = [...document.querySelectorAll(".sheet svg")];
told.sheets = sheets.length;
told.stills = sheets.filter((one) => one.getBoundingClientRect().width > 0).length;
const moving = () => [...document.querySelectorAll(".shapes circle")].map((one) => one.getAttribute("cx")).join();
told.over = [...document.querySelectorAll("body *")]
  .filter((one) => !one.closest(".scroll, pre, svg, [hidden], noscript"))
  .filter((one) => one.getBoundingClientRect().right > innerWidth + 1)
  .map((one) => one.outerHTML.slice(0, 80));
told.cut = [...document.querySelectorAll(".scroll")]
  .filter((one) => one.scrollWidth > one.clientWidth + 1 && (one.querySelector("img") || innerWidth > 1000))
  .map((one) => one.textContent.slice(0, 80));
told.sideways = document.documentElement.scrollWidth - document.documentElement.clientWidth;
const bottom = (words) => [...document.querySelectorAll("td, b")].find((one) => one.textContent.startsWith(words));
told.first = [document.querySelector(".verdict strong"), ...["Next:", "mode 1", "total mass"].map(bottom)]
  .map((one) => one.getBoundingClientRect().bottom);
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


def measured(page: str, folder: Path, width: int, height: int = 800, *, dark: bool = False) -> dict[str, Any]:
    """Open the page in a frame of this size, use every control, and return what its script tells."""
    inner = re.sub(r"script-src '[^']*'", "script-src 'unsafe-inline'", page)
    inner = inner.replace("<style>", ERRORS + "<style>", 1).replace("</body>", DRIVER + "</body>")
    (folder / "page.html").write_text(inner, encoding="utf-8")
    (folder / "frame.html").write_text(
        f'<body style="margin:0"><iframe src="page.html" style="border:0" width={width} height={height}></iframe>'
        "<pre id=told></pre><script>onmessage = (e) => { told.textContent = e.data; };</script>"
    )
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    return _told(folder, scheme)


STILL = """<script>
onload = () => {
  const page = document.querySelector("iframe").contentDocument;
  const wide = (one) => one.getBoundingClientRect().width > 100;
  const count = (what) => [...page.querySelectorAll(what)].filter(wide).length;
  const over = page.documentElement.scrollWidth - page.documentElement.clientWidth;
  document.querySelector("pre").textContent = JSON.stringify(
    { sheets: count(".sheet svg"), modes: count(".shapes svg"), controls: count("select, button"), sideways: over });
};
</script>"""


def seen_without_scripts(page: str, folder: Path, width: int, height: int = 800) -> dict[str, int]:
    """Number of curves, mode shapes and controls in a browser that runs no script, and what is wider than it."""
    (folder / "page.html").write_text(re.sub(r"script-src '[^']*'", "script-src 'none'", page), encoding="utf-8")
    frame = f'<iframe src="page.html" style="border:0" width={width} height={height}></iframe><pre id=told></pre>'
    (folder / "frame.html").write_text(frame + STILL)
    found: dict[str, int] = _told(folder, "--allow-file-access-from-files")
    return found


def pages_printed(page: Path, folder: Path) -> int:
    """Print to PDF: how many sheets."""
    pdf = folder / "page.pdf"
    _chromium(folder, f"--print-to-pdf={pdf}", page.as_uri())
    content = pdf.read_bytes()
    return len(re.findall(rb"/Type\s*/Page\b", content)) if content.startswith(b"%PDF") else 0


def _told(folder: Path, option: str) -> Any:
    """Message of the script of the frame."""
    ran = _chromium(folder, option, "--window-size=1400,900", "--dump-dom", (folder / "frame.html").as_uri())
    words = re.findall(r'<pre id="told">(.*?)</pre>', ran.stdout, re.DOTALL)[0]
    if not words:
        raise RuntimeError(f"the page's script did not end: {ran.stderr}")
    return json.loads(html.unescape(words))


def _chromium(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    command = [str(CHROMIUM), *OPTIONS, f"--user-data-dir={folder / 'user'}", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
