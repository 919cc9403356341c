"""How much do learning rate and discount matter, beside the luck of the seed? 256 seeds of each.

``python experiments/examples/seed_sweep.py`` trains 1,024 runs side by side and prints a line for
each configuration. The command line does the same and more: ``python -m mjx_reinforce.sweep
--help``.
"""

import dataclasses

from mjx_reinforce import iqm, iqm_interval, of_task, sweep

results = sweep(
    dataclasses.replace(of_task("InvertedPendulum-v5"), num_seeds=256),
    over={"learning_rate": [3e-3, 1e-2], "discount": [0.98, 0.99]},
)
for number, values in enumerate(results.configurations):
    returns = results.eval_return[-1, results.configuration == number]
    low, high = iqm_interval(returns)
    print(f"{values}: {iqm(returns):.1f} ({low:.1f} to {high:.1f}), worst {returns.min():.1f}")
