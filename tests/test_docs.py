"""The documents: every page is in the site's contents, and the reference has every public name."""

import contextlib
import io
import re
from pathlib import Path

import pytest

import sysid
from sysid.cli import main as cli

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.skipif(not (ROOT / "mkdocs.yml").exists(), reason="no documents beside the tests")


def test_every_page_is_in_the_contents_and_its_links_lead_somewhere():
    listed = re.findall(r"(\w+\.md)", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    pages = sorted((ROOT / "docs").glob("*.md"))
    assert sorted(listed) == [page.name for page in pages]
    for page in [*pages, ROOT / "README.md"]:
        for link in re.findall(r"\]\((?!https?://)([^)#]+)\)", page.read_text(encoding="utf-8")):
            assert (page.parent / link).exists(), f"{page.name}: {link}"


def test_the_reference_has_every_public_name():
    shown = set(
        re.findall(r"^::: [\w.]*?(\w+)$", (ROOT / "docs/reference.md").read_text(encoding="utf-8"), re.MULTILINE)
    )
    assert set(sysid.__all__) - shown == {"__version__", "plot"}  # sysid.plot stands as sysid.plot.plots
    assert "plots" in shown


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 150


def test_every_option_that_the_pages_name_is_there():
    commands = ("read", "run", "export", "report", "new", "show", "list", "compare", "refine", "doctor")
    with contextlib.redirect_stdout(io.StringIO()) as told:
        for command in commands:
            with contextlib.suppress(SystemExit):
                cli.main([command, "--help"])
    known = set(re.findall(r"--[a-z][a-z-]+", told.getvalue()))
    for name in ("README.md", *(f"docs/{page}.md" for page in ("command_line", "reading_files", "refinement_jobs"))):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)) <= known, name
        assert set(re.findall(r"[`\n]sysid ([a-z]+)\b", text)) <= set(commands), name
