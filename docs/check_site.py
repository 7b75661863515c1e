"""Follows every link of a site that was built: to files, to places in them; and says what would be fetched from a network.

python docs/check_site.py site
"""

from __future__ import annotations

import pathlib
import sys
from html.parser import HTMLParser
from urllib.parse import unquote, urlsplit

NETWORK = "http", "https"
ASSETS = ("script", "src"), ("img", "src"), ("link", "href"), ("source", "src"), ("iframe", "src")


class Page(HTMLParser):
    """Places and links of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.places, self.links, self.fetched = set[str](), set[str](), set[str]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """One element."""
        for name, value in attrs:
            if value is None:
                continue
            if name in ("id", "name"):
                self.places.add(value)
            elif name in ("href", "src"):
                (self.fetched if (tag, name) in ASSETS and urlsplit(value).scheme in NETWORK else self.links).add(value)


def broken(site: pathlib.Path) -> list[str]:
    """What is wrong with the pages of a folder."""
    pages = {file.resolve(): Page(file.read_text(encoding="utf-8")) for file in sorted(site.rglob("*.html"))}
    found = []
    for file, page in pages.items():
        name = file.relative_to(site.resolve())
        found += [f"{name} fetches {address}" for address in sorted(page.fetched)]
        for link in sorted(page.links):
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (file.parent / unquote(parts.path)).resolve() if parts.path else file
            if not target.exists():
                found.append(f"{name} leads to {link}, which is not there")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].places:
                found.append(f"{name} leads to {link}: there is no such place")
    return found if pages else [f"{site} has no pages"]


if __name__ == "__main__":
    wrong = broken(pathlib.Path(sys.argv[1]))
    print("\n".join(wrong), file=sys.stderr, end="\n" if wrong else "")
    sys.exit(bool(wrong))
