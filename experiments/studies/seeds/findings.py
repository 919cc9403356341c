"""All numbers of docs/seeds.md."""

import dataclasses
from collections.abc import Sequence

from experiments.studies.seeds.answers import Contrast, Effect, effects
from experiments.studies.seeds.few import COUNTS, AnyPair, FewSeeds, any_pair, few_seeds
from experiments.studies.seeds.runs import Task

#: By which few seeds name a winner.
FEW_MEASURES = ("final return", "average return")


@dataclasses.dataclass(frozen=True)
class Findings:
    """All numbers of the page."""

    tasks: Sequence[Task]
    effects: Sequence[Effect]
    few: Sequence[FewSeeds]
    pairs: Sequence[AnyPair]

    def of(self, contrast: Contrast, task: Task, where: str) -> list[Effect]:
        """Returns the effects of a contrast on a task, in the order of the measures."""
        wanted = (task.name, contrast.name, where)
        return [e for e in self.effects if (e.task, e.contrast, e.where) == wanted]


def find(tasks: Sequence[Task], counts: Sequence[int] = COUNTS) -> Findings:
    """Returns all numbers of the page.

    Args:
      tasks: what was measured.
      counts: numbers of seeds that are drawn from the many; those of the tables among them.
    """
    few = few_seeds(tasks, FEW_MEASURES, counts)
    pairs = [any_pair(task, measure, counts) for measure in FEW_MEASURES for task in tasks]
    return Findings(tasks, effects(tasks), few, pairs)
