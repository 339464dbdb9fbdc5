"""Names are unique: no two modules and no two classes of the packages share one."""

import ast
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path

from tests.markdown import SOURCES, text_of

#: Modules that Python finds by their names.
SPECIAL = {"__init__", "__main__"}


def modules(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the last part of a module's name; a package is also a module."""
    if path.stem == "__init__":
        yield path.parent.name, str(path)
    elif path.stem not in SPECIAL:
        yield path.stem, str(path)


def classes(source: str, place: str) -> Iterator[tuple[str, str]]:
    """Yield the names of a source file's classes, including nested ones."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ClassDef):
            yield node.name, f"{place}:{node.lineno}"


def shared(named: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Return the names that are not unique, with their places."""
    found = defaultdict(list)
    for name, place in named:
        found[name].append(place)
    return {name: places for name, places in found.items() if len(places) > 1}


def test_module_names_are_unique() -> None:
    assert shared(found for path in SOURCES for found in modules(path)) == {}


def test_class_names_are_unique() -> None:
    assert shared(found for p in SOURCES for found in classes(text_of(p), str(p))) == {}


def test_duplicate_names_are_found() -> None:
    paths = ("a/run.py", "b/run.py", "b/run/__init__.py", "a/__init__.py", "a/__main__.py")
    assert shared(found for path in paths for found in modules(Path(path))) == {
        "run": ["a/run.py", "b/run.py", "b/run/__init__.py"]
    }
    source = "class A:\n    class B: ...\nclass B: ...\nclass C: ...\n"
    assert set(shared(classes(source, "x"))) == {"B"}
