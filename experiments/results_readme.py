"""The part of README.md on results: every number of it follows from the small files."""

import textwrap
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import results_tables as tables
from mjx_reinforce.export.files import read_json
from results_files import Result, own_starts, tested_episodes
from results_tasks import PUBLISHED_STEPS, SECOND_ROOT, THIRD_ROOT
from seeds_markdown import listed
from tuning import KEPT

#: What is written anew of the README: from the one line to the other.
_FIRST, _LAST = "## Results\n", "Solved is a return of 950 in an evaluation"
_WIDTH = 110


def write(results: Sequence[Result], readme: Path) -> None:
    """Writes the part anew.

    Args:
      results: of all tasks.
      readme: the file.

    Raises:
      ValueError: the file has no such part.
    """
    before, first, rest = readme.read_text("utf-8").partition(_FIRST)
    _, last, after = rest.partition(_LAST)
    if not (first and last):
        raise ValueError(f"{readme} has no part between {_FIRST.strip()!r} and {_LAST!r}")
    readme.write_text(f"{before}{first}\n{part(results)}\n\n{last}{after}", encoding="utf-8")


def part(results: Sequence[Result]) -> str:
    """Returns the part: what was compared, both tables, and the picture between them."""
    shown = [result for result in results if result.task.name == result.task.env]
    pendulums = [result for result in results if result.task.env.startswith("InvertedPendulum-")]
    machines = listed(dict.fromkeys(tables.machine(result.facts) for result in pendulums))
    facts = pendulums[0].facts
    return "\n\n".join(
        [
            _filled(_caption(shown)),
            tables.readme_table(shown),
            "![Learning curves of every task](docs/results/curves.png)",
            f"{pendulums[0].task.name}, {facts['num_seeds']:,} fresh seeds of "
            f"{facts['settings']['env_steps'] / 1e6:g} million env steps each, on {machines}:",
            tables.readme_pendulum_table(pendulums),
        ]
    )


def _filled(text: str) -> str:
    """Returns a text in lines; none begins with a percent sign."""
    lines = textwrap.fill(text.replace(" %", "\0%"), _WIDTH, break_on_hyphens=False)
    return lines.replace("\0%", " %")


def _caption(results: Sequence[Result]) -> str:
    episodes = [tested_episodes(result) for result in results]
    shared = [_short(result) for result in results if not own_starts(result)]
    starts = "starts of the seed's own"
    if shared:
        some = f"{starts} (but for {listed(shared)}, whose seeds share theirs)"
        starts = some if len(shared) < len(results) else "starts that all seeds share"
    again = [_short(x) for x in results if x.task.root in (SECOND_ROOT, THIRD_ROOT)]
    return (
        "With the default settings of each task, but for the budgets, on seeds that no search "
        "used. Means over seeds of the last policies' returns without noise, each of "
        f"{min(episodes)} to {max(episodes)} episodes from {starts}, used nowhere else, with "
        "95 % bootstrap intervals over seeds; beside them Tianshou's REINFORCE "
        f"at {PUBLISHED_STEPS / 1e6:g} million env steps (10 seeds, its interval by Student's t). "
        f"{_verdicts(results)} This compares what was reached, not the methods: {_searched()}, "
        f"theirs is one setting for all tasks. {listed(again)} are second attempts with other "
        "settings and other seeds; docs/results.md says how the first ended. Ant and Humanoid were "
        "not apart after 700,000 and 200,000 env steps, and went on with the same seeds."
    )


def _verdicts(results: Sequence[Result]) -> str:
    """Returns in which tasks the intervals are apart, and with which part of the env steps."""
    by_verdict = {
        verdict: [result for result in results if tables.verdict_of(result) == verdict]
        for verdict in ("above", "not apart", "below")
    }
    clauses = []
    for verdict, words in (
        ("above", "Ours lie above theirs, intervals apart, in"),
        ("below", "below them, intervals apart, in"),
        ("not apart", "not apart in"),
    ):
        if found := by_verdict[verdict]:
            clauses.append(f"{words} {listed(map(_named, found))}")
    steps = [x.facts["settings"]["env_steps"] for found in by_verdict.values() for x in found]
    least, most = (100 * x / PUBLISHED_STEPS for x in (min(steps), max(steps)))
    return f"{'; '.join(clauses)}; with {least:.0f} to {most:.0f} % of the env steps."


def _named(result: Result) -> str:
    best = tables.mean_of(result).value == 1000 and result.task.env.startswith("InvertedPendulum-")
    return _short(result) + (" (both 1000, the most there is)" if best else "")


def _short(result: Result) -> str:
    """Returns the name of a task without its version."""
    return result.task.name.removesuffix("-v5")


def _searched() -> str:
    """Returns how many configurations were tried of each task before these runs."""
    tried: Counter[str] = Counter()
    for search in read_json(KEPT / "searches.json").values():
        env = search["settings"].get("env", "InvertedPendulum-v5")
        tried[env] += len(search["configurations"])
    (most, count), *others = tried.most_common()
    return (
        f"our settings were searched task by task (among {count:,} configurations for {most}, "
        f"{others[-1][1]} to {others[0][1]} for each of {len(others)} others, `experiments/tuning`)"
    )
