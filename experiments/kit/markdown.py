"""Numbers, lists and tables as Markdown."""

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence


def percent(share: float, digits: int, unit: str = "%") -> str:
    """Returns a share in percent; nothing where there is none."""
    return "" if math.isnan(share) else f"{fixed(100 * share, digits)}{unit}"


def fixed(x: float, digits: int) -> str:
    """Returns a number with so many decimals; what rounds to zero has no sign."""
    return f"{x:z,.{digits}f}"


def number(needed: float | None) -> str:
    """Returns a number of seeds; None and infinity are too many to count."""
    return "more than 10,000" if needed is None or math.isinf(needed) else f"{needed:,.0f}"


def listed(names: Iterable[str]) -> str:
    """Returns names as "a, b and c"."""
    names = list(names)
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Returns a table of a header and rows [R][C]."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def filled(text: str, tables: Mapping[str, Callable[[], str]]) -> str:
    """Returns a page whose text between ``<!-- NAME -->`` and ``<!-- end -->`` is made again.

    Args:
      text: the page, in Markdown.
      tables: by name, what makes the text; names that the page lacks are not made.
    """

    def made(found: re.Match[str]) -> str:
        return f"{found[1]}{tables[found[2]]()}\n<!-- end -->"

    # Other comments, such as of what is not run, stand on the page, too.
    names = "|".join(map(re.escape, tables))
    return re.sub(rf"(<!-- ({names}) -->\n).*?<!-- end -->", made, text, flags=re.DOTALL)
