"""Run directories as `train` writes them, of returns drawn by a formula: nobody trained."""

import csv
import json

from mjx_reinforce.training.rows import header

#: What a small sweep goes over.
ONE = {"learning_rate": [1e-3, 3e-3]}


def make_measured_run(
    directory,
    *,
    num_seeds=3,
    first=0,
    evaluations=4,
    offset=0.0,
    summary=None,
    terms=(),
    **settings,
):
    """Writes what a run leaves that a report reads: seed s returns 100 s + 10 e + offset.

    Term k of the reward adds up to k times that.
    """
    directory.mkdir(parents=True)
    config = {"env": "CartPole-v1", "learning_rate": 0.01, "hidden_sizes": [32, 32]} | settings
    provenance = {"python": "3.11.9", "device": "cpu", "packages": {"jax": "0.10.2"}}
    (directory / "config.json").write_text(json.dumps(config | provenance))
    said = {"status": "finished", "threshold": 195.0, "compile_seconds": 2.0}
    (directory / "summary.json").write_text(json.dumps(said | (summary or {})))
    with (directory / "metrics.csv").open("w", newline="") as file:
        columns = header(terms).decode().strip().split(",")
        writer = csv.DictWriter(file, columns, restval="", lineterminator="\n")
        writer.writeheader()
        for e in range(evaluations):
            for s in range(first, first + num_seeds):
                value = 100.0 * s + 10 * e + offset
                sums = {f"eval_{name}": k * value for k, name in enumerate(terms)}
                row = {"seed": s, "env_steps": 50 * e, "eval_return": value}
                writer.writerow(row | sums)
    return directory
