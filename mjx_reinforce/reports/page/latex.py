r"""The report's tables in LaTeX, for a document that has \usepackage{booktabs}."""

from collections.abc import Mapping, Sequence

from mjx_reinforce.reports.page.listings import Listing

#: What LaTeX would take for a command, and what it prints for it.
_SPECIAL = {
    **{each: f"\\{each}" for each in "&%$#_{}"},
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "\u00a0": "~",
    "\u2013": "--",
    "“": "``",
    "”": "''",
}


def tables(listed: Mapping[str, Listing]) -> dict[str, str]:
    """Returns the files by name: a ``tabular`` for each table of the page."""
    return {f"table-{name}.tex": tabular(**listing) for name, listing in listed.items()}


def tabular(header: Sequence[str], rows: Sequence[Mapping]) -> str:
    """Returns a table as a ``tabular`` of booktabs; intervals stand in brackets after their value.

    Args:
      header: the names of the columns.
      rows: a ``label`` and ``cells`` each, see ``listings.Listing``.
    """
    ranked = len(header) > 1 + len(rows[0]["cells"])
    lines = []
    for place, row in enumerate(rows, start=1):
        cells = [f"{value} ({below})" if below else value for value, below in row["cells"]]
        lines.append([*([str(place)] if ranked else []), row["label"], *cells])
    kinds = "r" * ranked + "l" + "r" * (len(header) - ranked - 1)
    body = [" & ".join(map(escaped, line)) + r" \\" for line in lines]
    names = " & ".join(map(escaped, header)) + r" \\"
    parts = [rf"\begin{{tabular}}{{{kinds}}}", r"\toprule", names, r"\midrule", *body]
    return "\n".join([*parts, r"\bottomrule", r"\end{tabular}", ""])


def escaped(text: str) -> str:
    """Returns a text that LaTeX prints as it is."""
    return "".join(_SPECIAL.get(each, each) for each in text)
