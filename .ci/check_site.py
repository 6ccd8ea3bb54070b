"""Check that the pages of a built site load nothing from other hosts.

python .ci/check_site.py build/site
"""

import sys
from html.parser import HTMLParser
from pathlib import Path

LOADED = {"link": "href", "script": "src", "img": "src", "iframe": "src", "source": "src"}


class _Loads(HTMLParser):
    """Collects the addresses that a page loads."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        address = dict(attrs).get(LOADED.get(tag, ""))
        if address is not None:
            self.addresses.append(address)


def main() -> int:
    site = Path(sys.argv[1])
    pages = sorted(site.rglob("*.html"))
    failures = []
    for page in pages:
        parser = _Loads()
        parser.feed(page.read_text(encoding="utf-8"))
        foreign = [x for x in parser.addresses if "//" in x and not x.startswith("data:")]
        failures += [f"{page.relative_to(site)}: loads {address}" for address in foreign]
    print(*failures, sep="\n", end="\n" if failures else "")
    print(f"{len(pages)} pages, {len(failures)} addresses of other hosts")
    return 1 if failures or not pages else 0


if __name__ == "__main__":
    sys.exit(main())
