"""A reader of the repository's Markdown pages."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]


def files(pattern: str) -> list[Path]:
    """Return the repository's files that match, relative to its root, without generated ones."""
    folders = [
        folder
        for folder in ROOT.iterdir()
        if folder.is_dir()
        and folder.name[0] != "."
        and folder.name not in ("build", "dist", "runs")
        and not (folder / "pyvenv.cfg").exists()
    ]
    found = [*ROOT.glob(pattern), *(path for folder in folders for path in folder.rglob(pattern))]
    return sorted(path.relative_to(ROOT) for path in found)


PAGES = files("*.md")
SOURCES = [
    path for path in files("*.py") if path.parts[0] in ("udrl", "proto", "services", "experiments")
]


def text_of(page: str | Path) -> str:
    return (ROOT / page).read_text(encoding="utf-8")


_INLINE = re.compile(r"`((?:[^`\n]|\n(?!\n))+)`")


class Block(NamedTuple):
    """A fenced block.

    Attributes:
        language: the info string's first word; empty for output and drawings.
        title: name of the file that the reader writes; usually empty.
        text: its content.
    """

    language: str
    title: str
    text: str


class Page:
    """A parsed page.

    Attributes:
        blocks: the fenced blocks.
        prose: everything else.
        inline: code in the prose, each on one line.
        words: the prose without it.
    """

    def __init__(self, page: str | Path) -> None:
        self.blocks: list[Block] = []
        self.prose = re.sub(
            r'^ *```(\w*)(?: title="([^"\n]*)")?[^\n]*\n(.*?)^ *```$',
            self._keep,
            text_of(page),
            flags=re.DOTALL | re.MULTILINE,
        )
        self.inline = [
            " ".join(code.replace("\\|", "|").split()) for code in _INLINE.findall(self.prose)
        ]
        self.words = _INLINE.sub("", self.prose)

    @property
    def code(self) -> list[tuple[str, str]]:
        """The contents of the fenced blocks, each with its language."""
        return [(block.language, block.text) for block in self.blocks]

    def _keep(self, match: re.Match[str]) -> str:
        self.blocks.append(Block(match[1], match[2] or "", match[3]))
        return ""


def section(page: str, heading: str) -> str:
    """Return the text below a heading, up to the next of its rank or higher."""
    marks = heading.split()[0]
    _, found, rest = f"\n{Page(page).prose}".partition(f"\n{heading}\n")
    assert found, f"{page} has no heading {heading!r}"
    return re.split(rf"\n#{{1,{len(marks)}}} ", rest)[0]


def tables(text: str) -> Iterator[list[list[str]]]:
    """Yield the tables of a text as rows of cells, without the line of dashes."""
    for table in re.findall(r"(?:^\|.*\n?)+", text, flags=re.MULTILINE):
        rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in table.strip().splitlines()]
        yield [[cell.strip() for cell in row] for row in (rows[0], *rows[2:])]


def records(text: str, header: str) -> list[list[str]]:
    """Return the rows of all tables in a text whose first column has this header."""
    return [row for table in tables(text) if table[0][0] == header for row in table[1:]]


def codes(text: str) -> list[str]:
    return re.findall(r"`([^`]+)`", text)


def names(text: str, header: str) -> list[str]:
    return [codes(row[0])[0] for row in records(text, header)]


def anchors(page: Path) -> set[str]:
    """Return the anchors that GitHub makes of a page's headings."""
    found: set[str] = set()
    for heading in re.findall(r"^#{1,6} (.+)$", Page(page).prose, flags=re.MULTILINE):
        plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).strip().lower()
        slug = re.sub(r"[^\w\- ]", "", plain).replace(" ", "-")
        number = sum(one == slug or re.fullmatch(rf"{slug}-\d+", one) is not None for one in found)
        found.add(f"{slug}-{number}" if number else slug)
    return found


def make_targets() -> list[str]:
    return re.findall(r"^([a-z][a-z-]*):(?!=)", text_of("Makefile"), flags=re.MULTILINE)
