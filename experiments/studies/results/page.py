"""docs/results.md, with its pictures: every number and word of it follows from the small files."""

from collections.abc import Collection, Sequence
from pathlib import Path

from experiments.kit.markdown import listed
from experiments.studies.results import figures, tables
from experiments.studies.results.files import (
    POLICIES,
    STAY_SOLVED,
    Result,
    own_starts,
    tested_episodes,
)
from experiments.studies.results.runs import FACTOR
from experiments.studies.results.tasks import PUBLISHED_SEEDS, PUBLISHED_STEPS, Task, horizon

_VERDICTS = {
    "above": "above the published figure",
    "not apart": "not apart from the published figure",
    "below": "below the published figure",
    "no interval": "without an interval to compare",
    "none published": "without a published figure",
    "none: a seed failed": "no mean, since a seed left the finite numbers",
}


def write(
    parts: Sequence[Result | Task],
    docs: Path,
    clock: Sequence[str] = (),
    filmed: Collection[str] = (),
) -> None:
    """Writes results.md, and its pictures into the folder results.

    Args:
      parts: what is kept of each task, or the task where nothing is.
      docs: the folder.
      clock: the sections on returns by seconds.
      filmed: the tasks of which those sections have the films.

    Raises:
      ValueError: nothing is kept of any task.
    """
    results = [part for part in parts if isinstance(part, Result)]
    if not results:
        raise ValueError("there is no result yet: run the stage train, then page DIR")
    figures.draw(results, docs / "results")
    (docs / "results.md").write_text(page(parts, docs, clock, filmed), encoding="utf-8")


def page(
    parts: Sequence[Result | Task],
    docs: Path,
    clock: Sequence[str] = (),
    filmed: Collection[str] = (),
) -> str:
    """Returns the page's text; films and pictures are linked where they are in ``docs``."""
    results = [part for part in parts if isinstance(part, Result)]
    sections = [
        "# Results",
        *clock,
        "## By env steps",
        _introduction(results),
        _missing(parts),
        tables.results_table(results),
        _verdicts(results),
        _notes(results),
        _explanation(results),
        *_pendulum(results),
        "## Learning curves",
        "![Learning curves of every task](results/curves.png)",
        *_played(results, docs, filmed),
        *_moved(results),
        "## How to do it again",
        _commands(results),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def _introduction(results: Sequence[Result]) -> str:
    roots = dict.fromkeys(f"{result.facts['settings']['seed']:,}" for result in results)
    return (
        "REINFORCE with the default settings of every task, except the budgets (env steps a\n"
        "seed, in the table) and the interval of evaluations; 32-32 also has\n"
        f"`--hidden-sizes 32 32`. No search used these seeds (roots {listed(roots)}).\n"
        "This page, words included, is written by `experiments/studies/results` from measured\n"
        "runs; last are the commands."
    )


def _missing(parts: Sequence[Result | Task]) -> str:
    missing = [part.name for part in parts if isinstance(part, Task)]
    unfinished = [
        part.task.name
        for part in parts
        if isinstance(part, Result) and part.facts["status"] != "finished"
    ]
    said = []
    if missing:
        said.append(f"Not run yet: {listed(missing)}.")
    if unfinished:
        said.append(f"Stopped, since nothing was finite any more: {listed(unfinished)}.")
    return " ".join(said)


def _verdicts(results: Sequence[Result]) -> str:
    said = []
    for verdict, words in _VERDICTS.items():
        tasks = [result.task.name for result in results if tables.verdict_of(result) == verdict]
        if tasks:
            said.append(f"* {words}: {listed(tasks)}")
    return "\n".join(["Means over seeds:", "", *said])


def _notes(results: Sequence[Result]) -> str:
    notes = [(result.task.name, result.task.note) for result in results if result.task.note]
    if not notes:
        return ""
    return "\n".join(["Of single tasks:", "", *(f"* {name}: {note}" for name, note in notes)])


def _explanation(results: Sequence[Result]) -> str:
    played: dict[int, list[str]] = {}
    for result in results:
        played.setdefault(tested_episodes(result), []).append(result.task.name)
    counts = [f"{count} ({listed(names)})" for count, names in sorted(played.items())]
    shared = [result.task.name for result in results if not own_starts(result)]
    evaluated = listed(
        str(x) for x in sorted({result.facts["settings"]["eval_episodes"] for result in results})
    )
    shorter = [
        f"{result.task.name} ({result.facts['settings']['horizon']} of {horizon(result.task.env)})"
        for result in results
        if result.facts["settings"]["horizon"] != horizon(result.task.env)
    ]
    said = [
        "* A return in the table is that of the policy at the end of training, without noise: a\n"
        "  seed's is the mean of episodes from starts that were used nowhere else. So many are\n"
        f"  they: {listed(counts)}.\n"
        "  Each seed has starts of its own, so intervals over seeds cover the choice of starts.\n"
        "  The evaluations on the way, and so the curves and the table of the pendulum, have\n"
        f"  others ({evaluated} episodes), the same at every evaluation of a seed.",
        "* IQM: the mean of the middle half of the seeds. Intervals are 95 % bootstrap\n"
        "  intervals over seeds ([statistics.md](statistics.md)).",
        f"* Published: Tianshou's REINFORCE after {PUBLISHED_STEPS:,} env steps,\n"
        f"  {PUBLISHED_SEEDS} seeds (examples/mujoco/README.md in its repository). What stands\n"
        "  there after ± is read as the standard deviation over seeds; the interval is Student's,\n"
        "  of the mean. Their mean is that of the evaluation where it was greatest, ours that at\n"
        "  the end; their tasks are Gym 0.17's -v2 and -v3, not in everything those of -v5. They\n"
        "  have one setting for all tasks, ours were searched for each\n"
        "  (`experiments/studies/tuning`).",
        "* Above: our interval of the mean lies above theirs; below: it lies below; not apart:\n"
        "  they overlap.",
        "* Training: wall time of all seeds together, evaluations included. Compiling: before\n"
        "  it, with whatever the machine's compilation cache held.",
    ]
    if shared:
        said.append(
            "* Trained before that, with the same starts for all seeds, so that intervals leave\n"
            f"  the choice of the starts out: {listed(shared)}."
        )
    cut = [
        f"{result.task.name} {result.facts['cut_short']:,} of {len(result.seeds['seed']):,} (after "
        f"{result.facts['settings']['max_updates']:,} updates)"
        for result in results
        if result.facts["cut_short"]
    ]
    if cut:
        said.append(
            "* Seeds whose episodes stayed so short that their updates did not use up their env\n"
            f"  steps ended there, and keep their last return: {listed(cut)}."
        )
    if shorter:
        said.append(f"* Episodes shorter than the task's limit, in steps: {listed(shorter)}.")
    return "\n".join(["How to read this:", "", *said])


def _pendulum(results: Sequence[Result]) -> list[str]:
    solved = [result for result in results if result.task.env.startswith("InvertedPendulum-")]
    if not solved:
        return []
    threshold = solved[0].facts["threshold"]
    start, stop = STAY_SOLVED
    return [
        "## InvertedPendulum-v5, seed by seed",
        f"Solved is a return of {threshold:g} in an evaluation. The least share solved is of\n"
        f"the seeds that are solved at once, at any time from {start:,} to {stop:,} env steps,\n"
        "each as its last evaluation until then showed it: a seed that falls again is not solved.",
        tables.pendulum_table(solved),
    ]


def _episodes(played: Sequence[Result]) -> str:
    """Returns how many episodes were played: "100 episodes (Ant-v5: 30)"."""
    counts = {
        result.task.name: int(result.played["episode"].max()) + 1
        for result in played
        if result.played is not None
    }
    most = max(counts.values())
    fewer = [f"{name}: {count:,}" for name, count in counts.items() if count < most]
    return f"{most:,} episodes" + (f" ({', '.join(fewer)})" if fewer else "")


def _played(results: Sequence[Result], docs: Path, filmed: Collection[str]) -> list[str]:
    """Returns the section; films of the tasks in ``filmed`` are of other runs."""
    played = [result for result in results if result.played is not None]
    if not played:
        return []
    pairs = [tables.comparison(result.played, policy) for result in played for policy in POLICIES]
    found = [pair for pair in pairs if pair is not None]
    first = played[0].played
    assert first is not None
    episodes = _episodes(played)
    version = next(str(x) for x in first["simulation"] if x != "ours")
    within = sum(pair.within for pair in found)
    apart = sum(not pair.difference.low <= 0 <= pair.difference.high for pair in found)
    words = (
        "The best and the median seed of every task by the final evaluation, without noise, in\n"
        f"{episodes} here and as many in plain {version.capitalize()}, each from\n"
        f"starts that were used nowhere else. Of {len(found)} policies, {within} have\n"
        "Gymnasium's mean within our 95 % interval. If both simulations were the same, that\n"
        "would be so for five in six: our interval knows nothing of the chance in Gymnasium's\n"
        "starts. The interval of the difference does, and would leave out zero for one in\n"
        f"twenty: it does for {apart} of {len(found)}."
    )
    missing = [result.task.name for result in results if result.played is None]
    words += f" Not played yet: {listed(missing)}." if missing else ""
    columns = {x.task.name: x.played for x in played if x.played is not None}
    films = {name: Path("films") / name for name in columns if name not in filmed}
    return ["## In Gymnasium, and films", words, tables.play_table(columns, films, docs)]


def _moved(results: Sequence[Result]) -> list[str]:
    swept = [result for result in results if result.moved is not None]
    if not swept:
        return []
    missing = [result.task.name for result in results if result.moved is None]
    words = (
        f"Each setting alone, at a third and at {FACTOR} times its default (discount, momentum\n"
        f"by their distance from 1: a third of that is the factor {FACTOR}), with the env steps\n"
        "that the table says. Drawn is the share of seeds solved at the end where the defaults\n"
        "solve half of them, else the IQM of the final return, both with 95 % intervals. What\n"
        "is *surely* worse or better has an interval apart from that of the defaults; nothing is\n"
        "corrected for how many are compared."
    )
    cut = [name for name, short in map(_cut_short, swept) if short]
    if cut:
        words += f" Runs that ended before, since their episodes stayed short: {listed(cut)}."
    shared = [x.task.name for x in swept if x.moved is not None and not x.moved["own_starts"].all()]
    if shared:
        words += (
            " With the same starts for all runs of a sweep, so that intervals leave the choice of\n"
            f"starts out: {listed(shared)}."
        )
    words += f" Not swept yet: {listed(missing)}." if missing else ""
    words += " HalfCheetah and Ant were swept before their episodes of training were cut."
    return [
        "## How much each setting matters",
        words,
        "![Solve rate or return against the factor of each setting](results/sensitivity.png)",
        tables.moved_table(swept),
    ]


def _cut_short(result: Result) -> tuple[str, int]:
    """Returns a task with how many runs of its sweep ended before their env steps, and that."""
    assert result.moved is not None
    short, runs = (int(result.moved[name].sum()) for name in ("cut_short", "seeds"))
    return f"{result.task.name} {short:,} of {runs:,}", short


def _commands(results: Sequence[Result]) -> str:
    facts = [result.facts for result in results]
    engines = listed(dict.fromkeys(str(one["engine"]) for one in facts))
    commits = listed(dict.fromkeys(str(one["git_commit"] or "unknown")[:12] for one in facts))
    jax = listed(dict.fromkeys(str(one["packages"]["jax"]) for one in facts))
    return f"""```sh
python -m experiments.studies.results train DIR        # every task, one after the other
python -m experiments.studies.results sensitivity DIR  # moves every setting
python -m experiments.studies.results play DIR         # Gymnasium and films
python -m experiments.studies.results seconds DIR      # runs that were given a time
python -m experiments.speed.peers sb3                  # Stable-Baselines3 in the same seconds
python -m experiments.studies.results page DIR         # this page
python -m experiments.studies.results readme           # the tables of README.md
```

`--tasks` chooses tasks; what is in DIR is kept, and what was stopped goes on. `page` without
DIR writes this page from the small files in `experiments/studies/results/data`: a row for each
seed, the curves as quantiles, the sweeps, and the return of every episode that was played.
Trained at commit {commits}, with the engine {engines} and JAX {jax}. A commit that the
repository does not have was joined with others as it landed."""
