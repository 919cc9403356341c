"""docs/seeds.md, with its pictures and tables."""

from pathlib import Path

from experiments.kit.markdown import listed
from experiments.studies.seeds import figures, tables, words
from experiments.studies.seeds.answers import CONTRASTS
from experiments.studies.seeds.findings import FEW_MEASURES, Findings

#: The text around the numbers.
_TEMPLATE = Path(__file__).with_suffix(".md")


def write(found: Findings, docs: Path) -> None:
    """Writes seeds.md, and its pictures and tables into the folder seeds.

    Args:
      found: all numbers.
      docs: the folder.
    """
    folder = docs / "seeds"
    folder.mkdir(parents=True, exist_ok=True)
    shown = [pair for pair in found.pairs if pair.measure == FEW_MEASURES[0]]
    figures.draw_all(found.tasks, found.effects, found.few, shown, folder)
    tables.write_csv(folder / "effects.csv", map(tables.effect_row, found.effects))
    tables.write_csv(folder / "wrong_winner.csv", tables.wrong_rows(found))
    tables.write_csv(folder / "arms.csv", tables.arm_rows(found.tasks))
    (docs / "seeds.md").write_text(page(found), encoding="utf-8")


def page(found: Findings) -> str:
    """Returns the page's text."""
    tasks, settings = found.tasks, found.tasks[0].record["settings"]
    texts = {
        "seeds": f"{tasks[0].record['num_seeds']:,}",
        "runs": f"{sum(task.final_return.size for task in tasks):,}",
        "configurations": f"{tasks[0].final_return[..., 0].size}",
        "tasks": listed([task.name for task in tasks]),
        "budget": listed(dict.fromkeys(f"{task.budget:,}" for task in tasks)),
        "max_updates": f"{settings['max_updates']:,}",
        "value_units": " and ".join(map(str, settings["value_hidden_sizes"])),
        "value_fits": settings["value_fits"],
        "rates": listed([f"{x:g}" for x in tasks[0].factors["learning_rate"]]),
        "effects": f"{len(found.effects):,}",
        "short_answers": words.short_answers(found),
        "short_few": words.short_few(found),
        "few_table": tables.few_table(found),
        "pairs_table": tables.pairs_table(found),
        "task_table": tables.task_table(tasks),
        "caveats": words.caveats(found),
        "provenance": words.provenance(tasks),
    }
    for question in dict.fromkeys(contrast.question for contrast in CONTRASTS):
        contrasts = [contrast for contrast in CONTRASTS if contrast.question == question]
        texts[f"{question}_answer"] = "\n\n".join(words.answer(found, c) for c in contrasts)
        texts[f"{question}_table"] = tables.effects_table(found, contrasts)
    return _TEMPLATE.read_text("utf-8").format(**texts)
