# %% [markdown]
# # A thousand seeds, and what three would have said
#
# Many papers compare two algorithms over three or five seeds. How often does such a comparison name the wrong winner?
# We train 1,000 seeds of each of two configurations. Then we draw three seeds of each, many times, as if they were all
# that we had.

# %%
import dataclasses

import matplotlib.pyplot as plt
import numpy as np

import mjx_reinforce as mr

SEEDS = 1000
config = dataclasses.replace(
    mr.of_task("InvertedPendulum-v5", env_steps=12_000), num_seeds=SEEDS, eval_episodes=4
)
swept = mr.sweep(config, over={"discount": [0.95, 0.995]}, quiet=True)
returns = swept.eval_return[-1].reshape(2, SEEDS)  # of the two configurations

# %% [markdown]
# ## All seeds
#
# With a thousand seeds there is little doubt.

# %%
discounts = [values["discount"] for values in swept.configurations]
for discount, each in zip(discounts, returns, strict=True):
    low, high = mr.iqm_interval(each)
    print(f"discount {discount}: IQM {mr.iqm(each):.0f} ({low:.0f} to {high:.0f})")
(comparison,) = mr.compare_all(list(returns))
better = mr.probability_of_improvement(returns[1], returns[0], paired=True)
print(f"a run of {discounts[1]} beats one of {discounts[0]} with {float(better.value):.0%}")
difference = mr.paired_difference(returns[1], returns[0])
print(f"mean difference {float(difference.value):.0f}, p = {float(difference.p_value):.1e}")
winner = int(returns[1].mean() > returns[0].mean())

# %% [markdown]
# ## What few seeds would have said
#
# Draw n seeds of each configuration, 20,000 times. The winner is the configuration with the higher mean.

# %%
rng = np.random.default_rng(0)
counts, wrong = [3, 5, 10, 20, 50, 100], []
for n in counts:
    drawn = rng.integers(SEEDS, size=(20_000, 2, n))
    means = np.stack([returns[k][drawn[:, k]].mean(-1) for k in range(2)])
    loser_ahead = means[1 - winner] > means[winner]
    tie = means[0] == means[1]
    wrong.append(float(np.mean(loser_ahead + 0.5 * tie)))
    print(f"{n:4d} seeds name the wrong winner {wrong[-1]:.1%} of the time")

# %%
fig, (left, right) = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
for discount, each in zip(discounts, returns, strict=True):
    left.hist(each, bins=40, histtype="step", label=f"discount {discount}")
left.set(xlabel="final return", ylabel="seeds")
left.legend()
right.semilogx(counts, wrong, "o-")
right.set_xticks(counts, counts, minor=False)
right.minorticks_off()
right.set(xlabel="seeds of each", ylabel="share of wrong winners", ylim=(0, 0.5))
fig.savefig("seeds.png", dpi=90)

# %% [markdown]
# ## To try
#
# 1. Compare medians in place of means.
# 2. Draw the *same* seeds for both configurations: does pairing help?
# 3. Sweep `learning_rate` in place of `discount`, or three values of both.
# 4. `python -m mjx_reinforce.sweep ... --output rates` writes a page with all of this, and more.
