"""The site that `make docs` built: nothing on any page asks another server for anything."""

import re
from pathlib import Path

import pytest

SITE = Path(__file__).parents[1] / "build" / "site"
FETCHED = re.compile(
    r"""<(?:script|img|iframe|source|audio|video)\b[^>]*\bsrc=["'](?:https?:)?//[^"']+"""
    r"""|<link\b(?![^>]*rel=["']canonical)[^>]*\bhref=["'](?:https?:)?//[^"']+|@import\s+url\(["']?(?:https?:)?//"""
)


@pytest.mark.skipif(not SITE.exists(), reason="the site is not built; `make docs` builds it, and CI before the tests")
def test_no_page_of_the_site_fetches_anything_from_elsewhere() -> None:
    pages = [*SITE.rglob("*.html"), *SITE.rglob("*.css")]
    assert len(pages) > 20
    found = {page.relative_to(SITE): FETCHED.findall(page.read_text(encoding="utf-8")) for page in pages}
    assert {page: hits for page, hits in found.items() if hits} == {}


@pytest.mark.skipif(not SITE.exists(), reason="the site is not built; `make docs` builds it, and CI before the tests")
def test_equations_are_in_the_pages_themselves() -> None:
    page = (SITE / "methods" / "luenberger.html").read_text(encoding="utf-8")
    assert page.count("<math") > 10
    assert "MathJax" not in page
    assert "\\(" not in page


def test_what_would_be_fetched_is_seen() -> None:
    for line in (
        '<script src="https://cdn.example/a.js">', "<img alt='' src='//example.org/a.png'>",
        '<link rel="stylesheet" href="https://example.org/a.css">', "@import url(https://example.org/a.css)",
    ):  # fmt: skip
        assert FETCHED.search(line)
    assert not FETCHED.search('<a href="https://zenoh.io">')
