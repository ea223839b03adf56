"""Pages of the site that are not Markdown in docs/: those of the root, notebooks, generated ones, and a reference."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import methods  # this and the next two: of this folder
import notebooks
import options
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "coliags_plugin"
DOCS = ROOT / "docs"
#: Pages of the repository's root, by their place in the site.
FROM_ROOT = {"index.md": "README.md", "contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
STYLE = ".md-typeset td:first-child code { white-space: nowrap; }\n"


def on_config(config: Any, **_: Any) -> Any:
    """Called by mkdocs first: pages of whole folders, and a section of the reference for each package."""
    for section in config.nav:
        ((title, pages),) = section.items()
        if isinstance(pages, str) and pages.endswith("/*"):
            section[title] = sorted(str(page.relative_to(DOCS)) for page in DOCS.glob(f"{pages}.md"))
    parts: dict[str, list[str]] = {}
    for name in modules():
        parts.setdefault(".".join(name.split(".")[:2]), []).append(f"reference/{name}.md")
    config.nav.append({"Reference": ["reference/index.md", *({part: pages} for part, pages in parts.items())]})
    return config


def on_files(files: Files, config: Any, **_: Any) -> Files:
    """Called by mkdocs when it has found the pages of docs/."""
    for page, name in FROM_ROOT.items():
        files.append(File.generated(config, page, content=for_site((ROOT / name).read_text(encoding="utf-8"))))
    files.append(File.generated(config, "site.css", content=STYLE))
    files.append(File.generated(config, "options.md", content=options.page()))
    files.append(File.generated(config, "method_table.md", content=methods.page()))
    files.append(File.generated(config, "layouts/index.md", content=formats()))
    for path in sorted(notebooks.NOTEBOOKS.glob("*.ipynb")):
        page = f"notebooks/{path.stem}.md"
        files.append(File.generated(config, page, content=notebooks.as_markdown(path)))
    for page, content in reference():
        files.append(File.generated(config, page, content=content))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs for each page: links to notebooks and to the folder of formats lead to their pages."""
    return re.sub(r"\.ipynb\)", ".md)", markdown).replace("](layouts/)", "](layouts/index.md)")


def formats() -> str:
    """A page that lists those of the data formats."""
    titles = {path.name: path.read_text(encoding="utf-8").partition("\n")[0] for path in DOCS.glob("layouts/*.md")}
    return "# Formats\n\n" + "".join(f"- [{title[2:]}]({name})\n" for name, title in sorted(titles.items()))


def for_site(text: str) -> str:
    """A page of the root with links as they are inside docs/."""
    text = re.sub(r"\]\(docs/([^)]+)\)", r"](\1)", text)
    for page, name in FROM_ROOT.items():
        text = text.replace(f"]({name}", f"]({page}")
    return text


def modules() -> list[str]:
    """Public modules, dotted, each package before what is in it."""
    paths = [path.relative_to(ROOT).with_suffix("") for path in PACKAGE.rglob("*.py")]
    names = [".".join(path.parts).removesuffix(".__init__") for path in paths]
    return sorted(name for name in names if not any(part.startswith("_") for part in name.split(".")))


def reference() -> Iterator[tuple[str, str]]:
    """A page for each module, and one that lists them."""
    listed = ["# Reference\n", "Every public module, from its docstrings.\n"]
    for name in modules():
        page = f"{name}.md"
        yield f"reference/{page}", f"---\ntitle: {name}\nsearch:\n  boost: 0.5\n---\n\n# {name}\n\n::: {name}\n"
        listed.append(f"- [{name}]({page}): {first_sentence(name)}")
    yield "reference/index.md", "\n".join(listed) + "\n"


def first_sentence(name: str) -> str:
    """What the module's docstring begins with."""
    path = ROOT.joinpath(*name.split("."))
    source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8")
    found = re.match(r'"""(.+?)(?:"""|\n\n)', source, re.DOTALL)
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", " ".join(found[1].split()).replace("``", "`")) if found else ""
