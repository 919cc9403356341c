"""Settings searched by Optuna: ask for some, train, stop what is hopeless, tell the return.

``pip install optuna``, then ``python experiments/examples/optuna_search.py --env Hopper-v5 --trials
40``. Each trial compiles its own program.
"""

import argparse
import dataclasses

import numpy as np

from mjx_reinforce import Config, of_task, run

try:
    import optuna  # pyright: ignore[reportMissingImports]  # not among the dependencies
except ImportError as error:
    raise SystemExit(f"error: this needs Optuna ({error}): pip install optuna") from error

#: Moments of a run at which trials are compared: parts of the budget.
MOMENTS = 20


def train(trial: optuna.Trial, base: Config) -> float | None:
    """Returns the mean test return over seeds; None if the pruner ended the run."""
    config = dataclasses.replace(
        base,
        learning_rate=trial.suggest_float("learning_rate", 1e-3, 1e-1, log=True),
        discount=1 - trial.suggest_float("1 - discount", 1e-3, 1e-1, log=True),
        initial_std=trial.suggest_float("initial_std", 0.1, 1.0, log=True),
    )
    returns: dict[int, float] = {}  # by moment

    def prune(evaluation):
        moment = int(MOMENTS * evaluation.env_steps.mean() / base.env_steps)
        if moment not in returns and moment < MOMENTS:
            returns[moment] = float(evaluation.measured["eval_return"].mean())
            trial.report(returns[moment], moment)
        return bool(returns) and trial.should_prune()  # a true value ends the run

    results = run(config, observers=[prune], quiet=True)
    whole = np.all(results.env_steps[-1] >= base.env_steps)
    return float(results.test_returns.mean()) if whole else None


def search(base: Config, trials: int) -> optuna.Study:
    """Returns a study with so many trials."""
    sampler = optuna.samplers.TPESampler(seed=0)
    pruner = optuna.pruners.MedianPruner(n_warmup_steps=MOMENTS // 4)  # until then all are alike
    study = optuna.create_study(direction="maximize", sampler=sampler, pruner=pruner)
    for _ in range(trials):
        trial = study.ask()
        value = train(trial, base)
        state = optuna.trial.TrialState.PRUNED if value is None else None
        study.tell(trial, value, state=state)
        print(trial.number, trial.params, "pruned" if value is None else value, flush=True)
    return study


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="InvertedPendulum-v5")
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--env-steps", type=int, help="budget of a seed")
    parser.add_argument("--seeds", type=int, default=4)
    given = parser.parse_args()
    base = dataclasses.replace(of_task(given.env, given.env_steps), num_seeds=given.seeds)
    best = search(base, given.trials).best_trial
    print(f"the best of the trials is {best.number}, {best.params}, with a return of {best.value}")
