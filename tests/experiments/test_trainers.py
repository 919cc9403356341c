"""Others' programs on our environments: what is changed in them, and that they train."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import trainers
from mjx_reinforce import envs, make_vec

ROW = dict.fromkeys(trainers.COLUMNS, "") | {"program": "P", "task": "T-v1", "num_envs": 8}
PROGRAM = """
if __name__ == "__main__":
    args = tyro.cli(Args)
    envs = gym.vector.SyncVectorEnv(
        [make_env(args.env_id, i) for i in range(args.num_envs)]
    )
    assert envs
"""


def test_one_statement_is_changed():
    pytest.importorskip("torch")
    import trainers_cleanrl

    changed = trainers_cleanrl.changed(PROGRAM).splitlines()
    before = PROGRAM.splitlines()
    assert changed == [*before[:3], "    " + trainers_cleanrl.LINE, before[-1]]
    for text in ("x = 1\n", PROGRAM + "    envs = 1\n"):
        with pytest.raises(ValueError, match=r"in [02] places; expected one"):
            trainers_cleanrl.changed(text)


def test_the_table_tells_means_with_intervals_and_median_seconds(tmp_path):
    path = tmp_path / "rows.csv"
    for side, returns in (("gymnasium", (10, 20, 60)), ("mjx_reinforce", (1000, 1010, 1020))):
        for seed, value in enumerate(returns):
            told = {"env_steps": 2048, "mean_return": value, "start_seconds": 1}
            times = {"seconds": seed + 1.5, "cpu_seconds": seed * 9}
            trainers.append(path, ROW | told | times | {"environment": side, "seed": seed})
    line = trainers.table(trainers.read(path)).splitlines()[2]
    program, task, num_envs, steps, theirs, ours, seconds, _ = line.strip("| ").split(" | ")
    assert (program, task, num_envs, steps) == ("P", "T-v1", "8", "2,048")
    assert theirs.startswith("30 (")
    assert ours.startswith("1,010 (1,")
    assert seconds == "2.5 (9.0 of a core)"


def test_brax_sees_the_environments_as_its_wrappers_show_them():
    """The same starts and actions: its rewards, ends and observations, until an episode ends."""
    from brax.envs.wrappers.training import wrap

    import peers_brax
    import trainers_brax

    vec = make_vec("InvertedPendulum-v5", 4, autoreset="same_step", max_episode_steps=9)
    ours = trainers_brax.Batched(vec)
    theirs = wrap(peers_brax.Rescaled(envs.make("InvertedPendulum-v5")), episode_length=9)
    keys = jax.random.split(jax.random.PRNGKey(0), 4)  # brax knows no others
    mine = ours.reset(keys)
    other = theirs.reset(jax.vmap(lambda key: jax.random.split(key)[1])(keys))
    assert (ours.observation_size, ours.action_size) == (4, 1)
    np.testing.assert_allclose(mine.obs, other.obs, atol=1e-6)
    action = jnp.array([[0.0], [0.01], [-0.01], [1.0]])
    step, their_step = jax.jit(ours.step), jax.jit(theirs.step)
    running = np.ones(4, bool)
    cut = 0
    for _ in range(9):
        mine, other = step(mine, action), their_step(other, action)
        for name in ("reward", "done"):
            found, expected = getattr(mine, name), getattr(other, name)
            np.testing.assert_allclose(found[running], expected[running], atol=1e-5)
        for name in ("truncation", "episode_done"):
            np.testing.assert_array_equal(mine.info[name][running], other.info[name][running])
        found, expected = (x.info["episode_metrics"] for x in (mine, other))
        for name in ("sum_reward", "length"):
            np.testing.assert_allclose(found[name][running], expected[name][running], atol=1e-4)
        cut += int(mine.info["truncation"][running].sum())
        running &= np.asarray(mine.done) == 0
        np.testing.assert_allclose(mine.obs[running], other.obs[running], atol=1e-4)
    assert 0 < cut < 4


@pytest.mark.filterwarnings("ignore")
def test_stable_baselines3_is_trained_on_both_sides(tmp_path, capsys):
    pytest.importorskip("stable_baselines3")
    path = tmp_path / "rows.csv"
    told = {"task": "InvertedPendulum-v5", "rollout": 256, "env_steps": 500, "seeds": (0, 1)}
    trainers.main(trainers.Sb3(**told, rows=path))
    rows = trainers.read(path)
    assert [(row["environment"], row["seed"]) for row in rows] == [
        *(("gymnasium", "0"), ("mjx_reinforce", "0")),
        *(("gymnasium", "1"), ("mjx_reinforce", "1")),
    ]
    assert all(row["env_steps"] == 512 and row["mean_return"] > 3 for row in rows)
    trainers.main(trainers.Table(rows=path))
    assert "| Stable-Baselines3 | InvertedPendulum-v5 | 8 | 512 | " in capsys.readouterr().out
