"""Do the presets learn as the programs they are named after? Their curves and ours, and a test.

    python experiments/reproduce.py --curves runs/reproduce --json rows.json  # twenty minutes
    python experiments/reproduce.py --preset categorical-cartpole --seeds 16

The programs' own curves, a few seeds each, are in reference.json. Ours come from many seeds that
train together. Where a program has a mistake that can be taken out, so do as many without it.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.scipy.stats import norm
from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn
from rich.table import Table
from scipy import stats

from mjx_reinforce import checkpoint, envs
from mjx_reinforce.build import build
from mjx_reinforce.config import Config
from mjx_reinforce.presets import PRESETS
from mjx_reinforce.train import Programs

_LEVEL = 0.05  # of the tests; the range over seeds holds 95 % likewise
_TUTORIAL = "gymnasium-tutorial"
_CLAMP = 1e-6
_STALE = "stale first observation"


@dataclasses.dataclass(frozen=True)
class Case:
    """A program of a document, and the preset that stands for it.

    document: which one, and so the figure
    title: of its panel
    preset: ours
    references: keys of reference.json, the program's own first
    counts: updates after which the two are compared
    updates: how many are made
    score: "episode_return" while training, or "eval_return"
    changes: settings over the preset's
    repair: what is put right in a second run of ours, and by which settings
    stale: also train with the program's mistake that no setting has, see ``stale_starts``
    """

    document: str
    title: str
    preset: str
    references: tuple[str, ...]
    counts: tuple[int, ...]
    updates: int
    score: str = "episode_return"
    changes: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    repair: tuple[str, Mapping[str, Any]] | None = None
    stale: bool = False


CASES = (
    Case(
        "000",
        "Gymnasium 0.26's tutorial, InvertedPendulum-v4",
        "gymnasium-tutorial-v0.26",
        ("000",),
        (500, 1500, 2500, 3800),
        3800,
        repair=("reward to go", {"estimator": "reward-to-go"}),
    ),
    Case(
        "001",
        "value baseline, InvertedPendulum-v5",
        "baseline-truncated-normal",
        ("001_InvertedPendulum-v5",),
        (100, 200, 300, 400),
        450,
        changes={
            "env": "InvertedPendulum-v5",
            "discount": 0.9995,
            "learning_rate": 1e-3,
            "value_learning_rate": 1e-3,
        },
        repair=("rescaled actions", {"rescale": True, "initial_std": 3.0}),
        stale=True,
    ),
    Case(
        "001",
        "value baseline, InvertedDoublePendulum-v5",
        "baseline-truncated-normal",
        ("001_InvertedDoublePendulum-v5", "001nostale_InvertedDoublePendulum-v5"),
        (500, 1000, 1500, 2500),
        3500,
        stale=True,
    ),
    Case(
        "002",
        "REINFORCE, mean action, continuous CartPole",
        "continuous-cartpole",
        ("002_reinforce",),
        (1, 5, 10, 20),
        20,
        score="eval_return",
        repair=("reward to go", {"estimator": "reward-to-go"}),
    ),
    Case(
        "002",
        "random search as written",
        "continuous-cartpole-ars",
        ("002_ars",),
        (50, 100, 200, 300),
        500,
        repair=("the paper's update", {"ars_update": "paper"}),
    ),
    Case(
        "002",
        "random search corrected",
        "continuous-cartpole-ars",
        ("002_ars_fixed2",),
        (20, 40, 60, 100),
        100,
        changes={"ars_update": "paper"},
    ),
    Case(
        "003",
        "Gymnasium's tutorial, InvertedPendulum-v4",
        _TUTORIAL,
        ("003",),
        (500, 1500, 2500, 3800),
        3800,
        repair=("fresh starts", {"one_start": False}),
    ),
    Case(
        "004",
        "categorical policy, CartPole-v0",
        "categorical-cartpole",
        ("004",),
        (200, 400, 600, 750),
        950,
        repair=("one step an episode", {"update": "full-batch"}),
    ),
)


@dataclasses.dataclass(frozen=True)
class Settings:
    """Train the presets and compare them with the programs' own curves."""

    preset: tuple[str, ...] = tuple(PRESETS)
    """Which presets."""
    seeds: int = 64
    """Seeds trained together."""
    max_updates: int | None = None
    """Stop early; later counts are left out."""
    repairs: bool = True
    """Also train without the programs' mistakes."""
    clamp: bool = False
    """Give truncated Normals the clamped density of torchrl, see ``clamped_log_prob``."""
    timing: bool = True
    """Also time the tutorial's experiment, 5 seeds of 5,000 episodes."""
    curves: Path | None = None
    """Folder that keeps returns; what lies there is not trained again, and not looked into."""
    figures: Path = Path("documents")
    """Folder for the figures."""
    json: Path | None = None
    """Where to write the rows."""


def main() -> None:
    """Trains, compares, prints, draws and writes."""
    settings = tyro.cli(Settings, description=__doc__)
    jax.config.update("jax_default_matmul_precision", "highest")
    results = run(settings)
    for title, rows in results.items():
        show(title, rows)
    print(
        f"agrees: p >= {_LEVEL}, of a rank test over seeds by permutation, two-sided. "
        f"Low, high: 2.5 and 97.5 % of our {settings.seeds} seeds; inside: of theirs, between them."
    )
    if settings.json:
        settings.json.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


def run(settings: Settings) -> dict[str, list[dict[str, Any]]]:
    """Trains and draws; returns the rows of the agreement, of the repairs and of the times."""
    reference = load_reference()
    chosen = [limit(case, settings.max_updates) for case in CASES if case.preset in settings.preset]
    agreement, repairs, panels = [], [], []
    for case in chosen:
        scores = train_case(case, settings)
        repaired = None
        if case.repair is not None and settings.repairs:
            repaired = train_case(case, settings, *case.repair)
            repairs += compare_repair(case, scores, repaired)
        for name in case.references:
            agreement += compare(case, name, reference[name], scores)
        stale = None
        if case.stale and settings.repairs:
            stale = train_case(case, settings, _STALE, stale=True)
            name = case.references[0]
            agreement += compare(case, name, reference[name], stale, f"{case.preset}, {_STALE}")
        panels.append((case, scores, repaired, stale))
        same = [panel for panel in panels if panel[0].document == case.document]
        settings.figures.mkdir(parents=True, exist_ok=True)
        draw(settings.figures / f"{case.document}.png", same, reference)
    times = []
    if settings.timing and _TUTORIAL in settings.preset:
        times = [time_tutorial(reference["003"], settings.max_updates)]
    return {"agreement": agreement, "repairs": repairs, "times": times}


def load_reference() -> dict[str, Any]:
    """Returns the programs' own curves, by program."""
    return json.loads(Path(__file__).with_name("reference.json").read_text(encoding="utf-8"))


def limit(case: Case, max_updates: int | None) -> Case:
    """Returns the case with no more than so many updates."""
    updates = case.updates if max_updates is None else min(case.updates, max_updates)
    counts = tuple(count for count in case.counts if count <= updates)
    return dataclasses.replace(case, updates=updates, counts=counts)


def settings_of(case: Case, num_seeds: int, changes: Mapping[str, Any]) -> Config:
    """Returns the settings of a run: evaluated after every update, or as good as never."""
    scored = case.score == "eval_return"
    config = dataclasses.replace(
        PRESETS[case.preset][1], num_seeds=num_seeds, max_updates=case.updates, **case.changes
    )
    every = 1 if scored else min(50, case.updates)
    episodes = config.eval_episodes if scored else 1
    return dataclasses.replace(config, eval_every=every, eval_episodes=episodes, **changes)


def train_case(
    case: Case,
    settings: Settings,
    label: str = "",
    changes: Mapping[str, Any] | None = None,
    *,
    stale: bool = False,
) -> np.ndarray:
    """Returns the score [U, S] of every update, from the folder of curves if it is there."""
    config = settings_of(case, settings.seeds, changes or {})
    digest = hashlib.sha256(
        repr((config, case.score) + (stale,) * stale + ("clamp",) * settings.clamp).encode()
    ).hexdigest()[:12]
    kept = settings.curves and settings.curves / f"{config.env}-{digest}.npy"
    if kept and kept.exists():
        return np.load(kept, allow_pickle=False)
    scores, _ = train(
        config,
        case.score,
        f"{case.title}{label and ', '}{label}",
        stale=stale,
        clamp=settings.clamp,
    )
    if kept:
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.save(kept, scores, allow_pickle=False)
    return scores


def train(
    config: Config, score: str, label: str, *, stale: bool = False, clamp: bool = False
) -> tuple[np.ndarray, dict[str, Any]]:
    """Trains all seeds together.

    Returns:
      The score [U, S] of every update; ``compile_seconds``, ``run_seconds`` and ``env_steps``.
    """
    assert config.max_updates is not None
    env = envs.make(config.env)
    started = time.perf_counter()
    patch = mock.patch.object(checkpoint, "build_policy", _clamped_policy)
    with patch if clamp and config.policy == "truncated-normal" else contextlib.nullcontext():
        learner, horizon = build(env, config)
    learner = stale_starts(learner) if stale else learner
    programs = Programs(env, learner, horizon, config)
    compiled = time.perf_counter()
    scores, env_steps, columns = [], 0, Progress.get_default_columns()
    with Progress(*columns, MofNCompleteColumn(), TimeElapsedColumn()) as progress:
        bar = progress.add_task(label, total=config.max_updates)
        for _ in range(-(-config.max_updates // config.eval_every)):
            programs.carry, metrics = programs.advance(programs.carry)
            active = np.asarray(metrics["active"])
            env_steps += int(np.sum(np.asarray(metrics["env_steps"]), where=active))
            evaluated = score == "eval_return"
            new = programs.evaluate()[score][None] if evaluated else np.asarray(metrics[score])
            scores.append(new)
            progress.update(bar, completed=min(len(scores) * config.eval_every, config.max_updates))
    seconds = time.perf_counter() - compiled
    times = {"compile_seconds": compiled - started, "run_seconds": seconds, "env_steps": env_steps}
    return np.concatenate(scores)[: config.max_updates], times


def clamped_log_prob(outputs: Any, action: Any, low: Any, high: Any) -> jax.Array:
    """Returns the log-density [...] of truncated Normals as torchrl computes it.

    Its distribution functions are clamped at 1e-6: with the mean far beyond a bound, what is left
    is a Normal's density without its constant, which pushes the mean on where the return is poor.

    Args:
      outputs: [..., 2 A] the means and the logarithms of the standard deviations.
      action: [..., A].
      low: [A] lower bounds.
      high: [A] upper bounds.
    """
    mean, log_std = jnp.split(outputs, 2, axis=-1)

    def probability(x):
        return jnp.clip(norm.cdf((x - mean) * jnp.exp(-log_std)), _CLAMP, 1 - _CLAMP)

    mass = jnp.maximum(probability(high) - probability(low), _CLAMP)
    return jnp.sum(norm.logpdf(action, mean, jnp.exp(log_std)) - jnp.log(mass), axis=-1)


def _clamped_policy(settings: dict[str, Any], build_policy: Any = checkpoint.build_policy) -> Any:
    policy = build_policy(settings)
    low, high = np.array(settings["action_low"]), np.array(settings["action_high"])
    log_prob = functools.partial(clamped_log_prob, low=low, high=high)
    return policy._replace(distribution=policy.distribution._replace(log_prob=log_prob))


class _StaleStart:
    """An environment that first shows an observation of something else, unless that is NaN."""

    def __init__(self, env: Any, shown: jax.Array):
        self._env, self._shown = env, shown

    def reset(self, rng: jax.Array) -> Any:
        state = self._env.reset(rng)
        return state.replace(obs=jnp.where(jnp.isnan(self._shown), state.obs, self._shown))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)


def stale_starts(learner: Any) -> Any:
    """Returns a learner of one episode an update with a mistake of document 001's program.

    Its loop over an episode's steps re-uses the variable that holds the next episode's first
    observation. So the first action of every episode but the first answers, and is trained on,
    the observation before the last action of the episode before. That travels in the state.
    """

    def init(key):
        state = learner.init(key)
        trajectory = jax.eval_shape(lambda: _play(learner, state, None)[1])
        nothing = jnp.full(trajectory.observation.shape[-1], jnp.nan)
        return dataclasses.replace(state, estimator_state=(state.estimator_state, nothing))

    def step(state, active=True):
        inner, shown = state.estimator_state
        played = dataclasses.replace(state, estimator_state=inner)
        (after, metrics), trajectory = _play(learner, played, shown, active)
        last = jnp.maximum(jnp.sum(trajectory.mask[:, 0]) - 1, 0)
        shown = jnp.where(active, trajectory.observation[last, 0], shown)
        return dataclasses.replace(after, estimator_state=(after.estimator_state, shown)), metrics

    return learner._replace(init=init, step=step)


def _play(learner: Any, state: Any, shown: jax.Array | None, active: Any = True) -> Any:
    """Returns what a step of the learner does, and the episodes that it played."""
    episodes = []

    def rollout(env, *args, **kwargs):
        env = env if shown is None else _StaleStart(env, shown)
        episodes.append(learner.engine.rollout(env, *args, **kwargs))
        return episodes[0]

    # The step is a partial of a function whose first argument plays the episodes.
    return learner.step.func(rollout, state, active), episodes[0]


def windowed(scores: np.ndarray, count: int, window: int) -> np.ndarray:
    """Returns the mean [S] of the scores [U, S] of up to ``window`` updates before a count."""
    return scores[max(0, count - window) : count].mean(axis=0)


def reached(entry: Mapping[str, Any], count: int) -> np.ndarray:
    """Returns the values after ``count`` updates of those of a program's seeds that got there."""
    index = count // entry["every_updates"] - 1
    return np.array([curve[index] for curve in entry["seeds"].values() if index < len(curve)])


def rank_test(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Returns the two-sided p value of a permutation test on mean ranks; ties share theirs."""
    ranks = stats.rankdata(np.concatenate([theirs, ours]))
    shuffled = np.random.default_rng(0).permuted(np.tile(ranks, (9999, 1)), axis=1)
    means = np.concatenate([ranks[None], shuffled])[:, : len(theirs)].mean(axis=1)
    distance = np.abs(means - ranks.mean())
    return float(np.mean(distance >= distance[0] - 1e-9))


def spread(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the 2.5 and 97.5 % quantiles over seeds, the last axis."""
    low, high = np.quantile(values, [_LEVEL / 2, 1 - _LEVEL / 2], axis=-1)
    return low, high


def compare(
    case: Case, name: str, entry: Mapping[str, Any], scores: np.ndarray, preset: str = ""
) -> list[dict[str, Any]]:
    """Returns a row for every count: our seeds, the program's, and whether they agree."""
    rows = []
    for count in case.counts:
        # The record has two decimals: those that tie there are to tie here.
        ours = windowed(scores, count, entry["window_updates"]).astype(float).round(2)
        theirs = reached(entry, count)
        low, high = map(float, spread(ours))
        p_value = rank_test(ours, theirs)
        rows.append(
            {
                "document": name,
                "preset": preset or case.preset,
                "episode": count * PRESETS[case.preset][1].episodes_per_update,
                "ours_mean": float(ours.mean()),
                "ours_low": low,
                "ours_high": high,
                "theirs_mean": float(theirs.mean()),
                "theirs_n": len(theirs),
                "inside": int(np.sum((theirs >= low) & (theirs <= high))),
                "p_value": p_value,
                "agrees": p_value >= _LEVEL,
            }
        )
    return rows


def compare_repair(
    case: Case, scores: np.ndarray, repaired: np.ndarray, window: int = 50
) -> list[dict[str, Any]]:
    """Returns the row that says what the repair does to our own seeds, at the last count."""
    if not case.counts or case.repair is None:
        return []
    count = case.counts[-1]
    window = 1 if case.score == "eval_return" else window
    before, after = windowed(scores, count, window), windowed(repaired, count, window)
    low, high = map(float, spread(after))
    return [
        {
            "document": case.references[0],
            "repair": case.repair[0],
            "episode": count * PRESETS[case.preset][1].episodes_per_update,
            "as_written_mean": float(before.mean()),
            "repaired_mean": float(after.mean()),
            "repaired_low": low,
            "repaired_high": high,
            "p_value": rank_test(before, after),
        }
    ]


def time_tutorial(entry: Mapping[str, Any], max_updates: int | None) -> dict[str, Any]:
    """Times the tutorial's experiment, and the part of it that all seeds on record played."""
    config = PRESETS[_TUTORIAL][1]
    updates = min(config.max_updates or 0, max_updates or 5000)
    config = dataclasses.replace(config, max_updates=updates, eval_every=min(100, updates))
    config = dataclasses.replace(config, eval_episodes=1)
    _, whole = train(config, "episode_return", "the tutorial's experiment, timed")
    common, theirs = entry["common"], sum(entry["common"]["wall_seconds"])
    common_config = dataclasses.replace(config, max_updates=min(common["updates"], updates))
    _, part = train(common_config, "episode_return", "as far as the record goes, timed")
    row = {"seeds": config.num_seeds, "episodes_each": updates, **whole}
    row["env_steps_per_second"] = whole["env_steps"] / whole["run_seconds"]
    row["record_steps_per_second"] = sum(common["env_steps"]) / theirs
    row["ratio_of_steps_per_second"] = row["env_steps_per_second"] / row["record_steps_per_second"]
    row["common_episodes_each"] = common_config.max_updates
    row["record_seconds"] = theirs
    row["ours_seconds"] = part["run_seconds"]
    row["ours_compile_seconds"] = part["compile_seconds"]
    row["ratio_of_seconds"] = theirs / part["run_seconds"]
    row["ratio_with_compiling"] = theirs / (part["run_seconds"] + part["compile_seconds"])
    return row


def show(title: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Prints a table; one row alone stands upright."""
    if not rows:
        return
    table = Table(title=title)
    if len(rows) == 1:
        rows = [{"what": key.replace("_", " "), "value": value} for key, value in rows[0].items()]
    for key in rows[0]:
        table.add_column(key.replace("_", " "), overflow="fold")
    for row in rows:
        table.add_row(*map(_format, row.values()))
    Console(width=180).print(table)


def _format(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
    return str(value)


def draw(
    path: Path,
    panels: Sequence[tuple[Case, np.ndarray, np.ndarray | None, np.ndarray | None]],
    reference: Mapping[str, Any],
) -> None:
    """Draws our seeds, ours without the mistake, and the program's, a panel for each case."""
    from matplotlib.figure import Figure

    size = (1 + 5 * max(len(panels), 1.4), 4)
    figure = Figure(figsize=size, dpi=90, layout="constrained")
    for axes, panel in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw_panel(axes, *panel, reference)
    figure.savefig(path)


def _draw_panel(
    axes: Any,
    case: Case,
    scores: np.ndarray,
    repaired: np.ndarray | None,
    stale: np.ndarray | None,
    reference: Mapping[str, Any],
) -> None:
    episodes = PRESETS[case.preset][1].episodes_per_update
    window = reference[case.references[0]]["window_updates"]
    curves = [(scores, "tab:blue", f"ours, {scores.shape[1]} seeds, 95 % of them")]
    if repaired is not None and case.repair is not None:
        curves.append((repaired, "tab:orange", f"ours, {case.repair[0]}"))
    if stale is not None:
        curves.append((stale, "tab:green", f"ours, {_STALE}"))
    for values, colour, label in curves:
        step = max(1, min(window, len(values)) // 5 if len(values) <= 500 else window)
        counts = range(step, len(values) + 1, step)
        smooth = np.stack([windowed(values, count, window) for count in counts])
        x = np.array(counts) * episodes
        axes.plot(x, smooth.mean(axis=1), color=colour, linewidth=2, label=label)
        axes.fill_between(x, *spread(smooth), color=colour, alpha=0.2, linewidth=0)
    last = len(scores) * episodes
    for name, colour in zip(case.references, ("black", "tab:red"), strict=False):
        _draw_program(axes, reference[name], episodes, last, colour, f"the program's ({name})")
    axes.set(xlabel="episodes", ylabel="return", title=case.title, xlim=(0, last))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="x-small", frameon=False)


def _draw_program(
    axes: Any, entry: Mapping[str, Any], episodes: int, last: int, colour: str, label: str
) -> None:
    for index, curve in enumerate(entry["seeds"].values()):
        x = (1 + np.arange(len(curve))) * entry["every_updates"] * episodes
        shown = x <= last
        y = np.array(curve)[shown]
        text = label if index == 0 else None
        axes.plot(x[shown], y, color=colour, linewidth=0.8, alpha=0.8, label=text)


if __name__ == "__main__":
    main()
