"""Turns the repository into the site's pages (mkdocs.yml).

Links between pages are relative to the repository's files, so that they work on a code host. The
site has every page at the same path, so the same links work there and mkdocs checks them. Links to
other files and to directories lead to a page with the file's content, or with a list of files.

The pages in api/ of the navigation are the docstrings of a module.
"""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PAGES = ("*.md", "docs/*.md", "proto/**/*.md")
#: Published as they are.
ASSETS = {".css", ".csv", ".gif", ".png"}
#: Listed in the page of a directory.
SOURCES = {".json", ".py", ".toml", ".yaml"}
#: What highlights a file whose suffix does not.
LANGUAGES = {"": "text", ".json5": "json", ".sbatch": "bash"}
#: What a module has from other modules, on its page in api/.
OFFERED = {"udrl": ("udrl.train", "udrl_launch.api.Trained", "udrl.load")}

_LINK = re.compile(r"\]\(([^)\s#:]+)(#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Return the site's files: the theme's, and the repository's instead of those in docs/."""
    of_theme = [file for file in files if file.src_dir != config.docs_dir]
    pages = sorted(path for pattern in PAGES for path in ROOT.glob(pattern))
    found = {path: _file(path, config) for path in pages}
    for target in sorted({target for page in pages for target in _targets(page)}):
        for path in (target, *_inside(target, deep=True)):
            if path not in found:
                found[path] = _shown(path, config)
    found |= {style: _file(style, config) for style in ROOT.glob("docs/*.css")}
    references = [
        File.generated(config, f"api/{module}.md", content=_reference(module))
        for module in _modules(config.nav)
    ]
    return Files([*of_theme, *found.values(), *references])


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page as Python-Markdown needs it, with links to the site's pages."""
    if page.file.generated_by:
        return markdown
    here = ROOT / posixpath.dirname(page.file.src_uri)
    return _for_python_markdown(_LINK.sub(lambda link: _relinked(link, here), markdown))


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page without the reStructuredText of docstrings."""
    if not page.file.src_uri.startswith("api/"):
        return html
    html = re.sub(r":\w+:<code>~?", "<code>", html)
    return html.replace("<p>::</p>", "").replace("::</p>", ":</p>")


def _file(path: Path, config: MkDocsConfig) -> File:
    uri = path.relative_to(ROOT).as_posix()
    return File(uri, str(ROOT), config.site_dir, config.use_directory_urls)


def _targets(page: Path) -> Iterator[Path]:
    """Yield what a page links to, except pages."""
    for target, _ in _LINK.findall(page.read_text(encoding="utf-8")):
        path = (page.parent / target).resolve()
        if path.suffix != ".md" and path.exists():
            yield path


def _inside(path: Path, *, deep: bool = False) -> list[Path]:
    """Return the files to list of a directory, or of it and those in it; of a file, none."""
    if not path.is_dir():
        return []
    found = [p for p in sorted(path.iterdir()) if p.suffix in SOURCES or _inside(p)]
    return [*found, *(q for p in found if deep for q in _inside(p, deep=True))]


def _suffix(path: Path) -> str:
    """Return what a path has to end in besides, to be that of the page that shows it."""
    if path.is_dir():
        return "/index.md"
    return "" if path.suffix in {*ASSETS, ".md"} else ".md"


def _shown(path: Path, config: MkDocsConfig) -> File:
    """Return the page of a file or directory, or the file itself."""
    if path.suffix in ASSETS:
        return _file(path, config)
    uri = path.relative_to(ROOT).as_posix()
    if path.is_dir():
        content = "".join(f"- [`{p.name}`]({p.name}{_suffix(p)})\n" for p in _inside(path))
    else:
        language = LANGUAGES.get(path.suffix, path.suffix[1:])
        content = f"~~~~~~~~ {language}\n{path.read_text(encoding='utf-8')}~~~~~~~~\n"
    content = f"---\nsearch:\n  exclude: true\n---\n\n# `{uri}`\n\n{content}"
    return File.generated(
        config, uri + _suffix(path), content=content, inclusion=InclusionLevel.NOT_IN_NAV
    )


def _relinked(link: re.Match[str], here: Path) -> str:
    target, anchor = link[1].rstrip("/"), link[2] or ""
    path = here / target
    return f"]({target}{_suffix(path)}{anchor})" if path.exists() else link[0]


def _for_python_markdown(markdown: str) -> str:
    """Return a page of a code host's Markdown as Python-Markdown reads it.

    In lists it needs four spaces where two or three are enough elsewhere. In tables it keeps the
    backslash of a bar in code.
    """
    lines, is_code = [], False
    for line in markdown.splitlines():
        is_code ^= line.startswith("```")
        if not is_code:
            line = re.sub(r"^ {1,3}(?=\S)", "    ", line)
        if line.startswith("|"):
            line = re.sub(r"`[^`]+`", lambda code: code[0].replace("\\|", "|"), line)
        lines.append(line)
    return "\n".join(lines)


def _modules(nav: Any) -> Iterator[str]:
    """Yield the modules in the navigation."""
    if isinstance(nav, str):
        if nav.startswith("api/"):
            yield nav.removeprefix("api/").removesuffix(".md")
    elif nav:
        for part in nav.values() if isinstance(nav, dict) else nav:
            yield from _modules(part)


def _reference(module: str) -> str:
    """Return the page of a module."""
    if module not in OFFERED:
        return f"# `{module}`\n\n::: {module}\n"
    options = "    options: {show_root_heading: true, show_root_toc_entry: true}\n"
    return f"# `{module}`\n\n" + "\n".join(f"::: {name}\n{options}" for name in OFFERED[module])
