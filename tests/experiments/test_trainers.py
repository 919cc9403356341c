"""Others' programs on our environments: what is changed in them, and that they train."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.kit import rows as kit
from experiments.speed.trainers import __main__ as trainers
from mjx_reinforce.vector import for_brax

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
    from experiments.speed.trainers import cleanrl_ppo

    changed = cleanrl_ppo.changed(PROGRAM).splitlines()
    before = PROGRAM.splitlines()
    assert changed == [*before[:3], "    " + cleanrl_ppo.LINE, before[-1]]
    for text in ("x = 1\n", PROGRAM + "    envs = 1\n"):
        with pytest.raises(ValueError, match=r"in [02] places; expected one"):
            cleanrl_ppo.changed(text)


def test_the_table_tells_means_with_ranges_and_median_seconds(tmp_path):
    path = tmp_path / "rows.csv"
    for side, returns in (("gymnasium", (10, 20, 60)), ("mjx_reinforce", (1000, 1010, 1020))):
        for seed, value in enumerate(returns):
            told = {"env_steps": 2048, "mean_return": value, "start_seconds": 1}
            times = {"seconds": seed + 1.2, "cpu_seconds": seed * 9}
            row = ROW | told | times | {"environment": side, "seed": seed}
            kit.append(path, [row], trainers.COLUMNS)
    line = trainers.table(trainers.read(path)).splitlines()[2]
    *case, steps, seeds, theirs, ours, seconds, _ = line.strip("| ").split(" | ")
    assert [*case, steps, seeds] == ["P", "T-v1", "8", "2,048", "3"]
    assert (theirs, ours) == ("30 (10 to 60)", "1,010 (1,000 to 1,020)")
    assert seconds == "2 (9)"


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
    assert "| Stable-Baselines3 | InvertedPendulum-v5 | 8 | 512 | 2 | " in capsys.readouterr().out


@pytest.mark.filterwarnings("ignore")
def test_rejax_maps_one_environment_in_one_call():
    pytest.importorskip("rejax")
    from experiments.speed.trainers import rejax_ppo

    task = "InvertedPendulum-v5"
    one, many = rejax_ppo.OneOfMany(task), for_brax.make(task, 3)
    keys = jax.random.split(jax.random.PRNGKey(0), 3)
    first = jax.vmap(lambda key: jax.random.fold_in(key, 0))(keys)
    (obs, state), other = jax.vmap(one.reset)(keys), many.reset(first)
    np.testing.assert_array_equal(obs, other.obs)
    mapped = jax.jit(jax.vmap(one.step))
    assert str(jax.make_jaxpr(mapped)(keys, state, jnp.zeros((3, 1)))).count("ffi_call[") == 1
    ended = 0
    for _ in range(20):
        action = jnp.array([[1.0], [-1.0], [0.1]])
        obs, state, reward, done, _ = mapped(keys, state, action)
        other = many.step(other, action)
        for found, expected in ((obs, other.obs), (reward, other.reward), (done, other.done)):
            np.testing.assert_array_equal(found, expected)
        ended += int(done.sum())
    assert ended > 1
