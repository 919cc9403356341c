# %% [markdown]
# # A minute on each task
#
# By default, a task trains for about a minute on two cores or on a GPU; easy tasks need less. Here each task trains two
# seeds. Compiling takes extra time.

# %%
import time

import matplotlib.pyplot as plt

import mjx_reinforce as mr

TASKS = ("InvertedPendulum-v5", "Reacher-v5", "Swimmer-v5", "Hopper-v5", "HalfCheetah-v5")

# %%
trained = {}
for task in TASKS:
    begin = time.perf_counter()
    config = mr.of_task(task, num_seeds=2)
    trained[task] = mr.run(config, quiet=True)
    print(
        f"{task}: {trained[task].test_returns.mean():.0f} after {config.env_steps:,} env steps per seed,"
        f" {time.perf_counter() - begin:.0f} s with compiling"
    )

# %%
fig, axes = plt.subplots(1, len(TASKS), figsize=(12, 2.8), layout="constrained")
for ax, (task, results) in zip(axes, trained.items(), strict=True):
    ax.plot(results.env_steps / 1e3, results.eval_return)
    if (threshold := mr.envs.make(task).reward_threshold) is not None:
        ax.axhline(threshold, color="gray", linestyle=":")
    ax.set(title=task, xlabel="thousand env steps")
axes[0].set_ylabel("return of two seeds")
fig.savefig("tasks.png", dpi=80)

# %% [markdown]
# The dotted line is the return that counts as solved. `trained["Hopper-v5"].player()` is a policy that acts on
# observations. [What it reaches](../results.md) has the figures of all tasks, on a quiet machine and on a GPU.
