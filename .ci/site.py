"""What mkdocs does besides Markdown: formulas, notebooks, and files from outside of docs/.

GitHub Actions names the repository in GITHUB_REPOSITORY. Only then pages have links to it and
notebooks a button for Colab, which opens the notebooks of the branch that the site is on.
"""

import html
import json
import os
import re
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
REPOSITORY = os.environ.get("GITHUB_REPOSITORY")
PAGES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
#: Pages that the search shows before others with the same words.
FOUND_FIRST = ("own_task.md",)
PAGES_OF_README = {"README.md": "index.md"} | PAGES


def on_config(config):
    """Names the repository and the address of the site, where they are known."""
    if REPOSITORY:
        owner, name = REPOSITORY.split("/")
        config.repo_url = f"https://github.com/{REPOSITORY}"
        config.site_url = f"https://{owner}.github.io/{name}/"


def on_files(files, config):
    """Adds the changelog, CONTRIBUTING, notebooks and the source files that pages link to."""
    pages = [file.content_string for file in files.documentation_pages()]
    for source, page in PAGES.items():
        text = (ROOT / source).read_text("utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
        pages.append(text)
    for script in sorted((ROOT / "docs/notebooks").glob("*.py")):
        cells = read_cells(script.read_text("utf-8"))
        page = f"notebooks/{script.stem}.md"
        pages.append(as_page(script.stem, cells))
        files.append(File.generated(config, page, content=pages[-1]))
        notebook = json.dumps(as_notebook(cells), indent=1)
        files.append(File.generated(config, f"notebooks/{script.stem}.ipynb", content=notebook))
    for link in {link for page in pages for link in re.findall(r"\]\((?:\.\./)+([\w./-]+)", page)}:
        if link not in PAGES_OF_README and (ROOT / link).is_file():
            files.append(File.generated(config, f"source/{link}", abs_src_path=str(ROOT / link)))
    return files


def on_page_markdown(markdown, page, **_):
    """Turns links to files outside of docs/ into links to their copies on the site."""
    if page.file.src_uri in FOUND_FIRST:
        page.meta["search"] = {"boost": 4}
    up = "../" * page.file.src_uri.count("/")
    markdown = re.sub(r"\]\(((?:\.\./)?notebooks/\w+)\.py\)", r"](\1.md)", markdown)

    def inside(link):
        target = link[1]
        return f"]({up}{PAGES_OF_README.get(target, 'source/' + target)}"

    return re.sub(rf"\]\({re.escape(up)}\.\./([\w./-]+)", inside, markdown)


def on_page_content(content, **_):
    """Sets formulas as MathML, which browsers show without any script."""

    def formula(found):
        display = "block" if found[1] == "div" else "inline"
        return convert(html.unescape(found[2]), display=display)

    return re.sub(
        r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', formula, content, flags=re.S
    )


def read_cells(script):
    """Returns the cells of a script in jupytext's percent format: (is it text, its text)."""
    cells = []
    for cell in re.split(r"^# %%", script, flags=re.M)[1:]:
        kind, _, body = cell.partition("\n")
        text = "[markdown]" in kind
        body = re.sub(r"^# ?", "", body, flags=re.M) if text else body
        cells.append((text, body.strip()))
    return cells


def as_page(name, cells):
    """Returns the Markdown of a notebook."""
    parts = [body if text else f"```python\n{body}\n```" for text, body in cells]
    links = f"[Notebook]({name}.ipynb){{ .md-button }}"
    if REPOSITORY:
        colab = f"https://colab.research.google.com/github/{REPOSITORY}/blob/gh-pages/notebooks"
        links = f"[Open in Colab]({colab}/{name}.ipynb){{ .md-button }} " + links
    return "\n\n".join([parts[0], links, f"![What this notebook draws]({name}.png)", *parts[1:]])


def as_notebook(cells):
    """Returns the notebook for Jupyter and Colab, with a cell that installs the package."""
    package = f"git+https://github.com/{REPOSITORY}" if REPOSITORY else "mjx-reinforce"
    cells = [cells[0], (False, f"%pip install -q {package}"), *cells[1:]]
    return {
        "cells": [
            {"cell_type": "markdown", "metadata": {}, "source": body.splitlines(True)}
            if text
            else {
                "cell_type": "code",
                "execution_count": None,
                "metadata": {},
                "outputs": [],
                "source": body.splitlines(True),
            }
            for text, body in cells
        ],
        "metadata": {"kernelspec": {"display_name": "Python 3", "name": "python3"}},
        "nbformat": 4,
        "nbformat_minor": 4,
    }
