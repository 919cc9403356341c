"""The documents' programs, the presets that stand for them, and what is put right in them."""

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

#: The module of what is put right.
REPAIRS = "experiments.studies.reproduce.repairs"


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
    repair: what is put right in a second run of ours, and by which --algorithm
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
    repair: tuple[str, str] | None = None
    stale: bool = False


CASES = (
    Case(
        "000",
        "Gymnasium 0.26's tutorial, InvertedPendulum-v4",
        "gymnasium-tutorial-v0.26",
        ("000",),
        (500, 1500, 2500, 3800),
        3800,
        repair=("reward to go", "gymnasium-tutorial"),
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
        repair=("rescaled actions", f"{REPAIRS}:rescaled_actions"),
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
        repair=("reward to go", f"{REPAIRS}:plain_returns"),
    ),
    Case(
        "002",
        "random search as written",
        "continuous-cartpole-ars",
        ("002_ars",),
        (50, 100, 200, 300),
        500,
        repair=("the paper's update", f"{REPAIRS}:papers_update"),
    ),
    Case(
        "002",
        "random search corrected",
        "continuous-cartpole-ars",
        ("002_ars_fixed2",),
        (20, 40, 60, 100),
        100,
        changes={"algorithm": f"{REPAIRS}:papers_update", "num_episodes": 20},
    ),
    Case(
        "003",
        "Gymnasium's tutorial, InvertedPendulum-v4",
        "gymnasium-tutorial",
        ("003",),
        (500, 1500, 2500, 3800),
        3800,
        repair=("fresh starts", f"{REPAIRS}:fresh_starts"),
    ),
    Case(
        "004",
        "categorical policy, CartPole-v0",
        "categorical-cartpole",
        ("004",),
        (200, 400, 600, 750),
        950,
        repair=("one step an episode", f"{REPAIRS}:one_step"),
    ),
)


def load_reference() -> dict[str, Any]:
    """Returns the programs' own curves, by program."""
    return json.loads(Path(__file__).with_name("reference.json").read_text(encoding="utf-8"))


def limit(case: Case, max_updates: int | None) -> Case:
    """Returns the case with no more than so many updates."""
    updates = case.updates if max_updates is None else min(case.updates, max_updates)
    counts = tuple(count for count in case.counts if count <= updates)
    return dataclasses.replace(case, updates=updates, counts=counts)
