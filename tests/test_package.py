"""What a package page shows: no picture and no link of it is broken."""

from __future__ import annotations

import re
import runpy

from conftest import ROOT

description = runpy.run_path(str(ROOT / "setup.py"))["description"]
README = (ROOT / "README.md").read_text()


def test_pictures_and_links_point_into_the_repository_where_it_is_known():
    text = description(README, "https://example.org/lunargr")
    found = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", text)
    assert found
    for address in found:
        assert (ROOT / address.removeprefix("https://example.org/lunargr/raw/main/")).is_file(), address
    assert "](docs/" not in text and "(https://example.org/lunargr/blob/main/CITATION.cff)" in text


def test_without_an_address_words_stay_and_pictures_go():
    text = description(README, "")
    assert "![" not in text and not re.search(r"\]\((?!https?:|#)", text)
    assert "tutorial goes on from here" in text
