"""The documents: every page is in the site's contents, and the reference has every public name."""

import re
from pathlib import Path

import pytest

import sysid

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
