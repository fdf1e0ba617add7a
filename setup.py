"""The package's description: README.md, whose pictures and links are files of the repository.

A package page shows pictures from https addresses alone. `make wheel URL=https://...` names the repository: links and pictures then
point there. Without it pictures are left out and links become their words, so that nothing on the page is broken.
"""

import os
import re
from pathlib import Path

from setuptools import setup

LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!https?:|#)([^)]*)\)")


def description(readme: str, url: str) -> str:
    """The README for a package page. url : of the repository, '' where it has none"""

    def absolute(found: re.Match[str]) -> str:
        picture, words, path = found.groups()
        if not url:
            return "" if picture else words
        return f"{picture}[{words}]({url}/{'raw' if picture else 'blob'}/main/{path})"

    return LINK.sub(absolute, readme)


if __name__ == "__main__":
    url = os.environ.get("LUNARGR_URL", "").rstrip("/")
    text = description((Path(__file__).resolve().parent / "README.md").read_text(encoding="utf-8"), url)
    about = {
        "Repository": url,
        "Documentation": f"{url}/blob/main/docs/index.md",
        "Changelog": f"{url}/blob/main/CHANGELOG.md",
    }
    setup(
        long_description=text,
        long_description_content_type="text/markdown",
        project_urls=about | {"Issues": f"{url}/issues"} if url else {},
    )
