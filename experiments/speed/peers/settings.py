"""The settings of the peers: what their own authors published for each task or the nearest one."""

from collections.abc import Mapping
from typing import Any, NamedTuple

_ZOO = "DLR-RM/rl-baselines3-zoo 22e3ff2450fd92033f7f032915e1f64894a09584 hyperparams/{}.yml"
_BRAX = "google/brax 0b96d056328d15ea7ebfd3ce07f42be72ec76e40 notebooks/training.ipynb"
_PLAYGROUND = (
    "google-deepmind/mujoco_playground d5e6b47531328468da1eec33b8b304a00bb0873c "
    "mujoco_playground/config/dm_control_suite_params.py"
)


class Sb3(NamedTuple):
    """Settings of a Stable-Baselines3 algorithm on a task.

    source: where they stand, or that they are the defaults of Stable-Baselines3
    num_envs: environments that are stepped one after the other, in one process
    normalize: whether observations and rewards are normalized by their running scales
    arguments: of the algorithm's class
    policy: ``policy_kwargs`` of the algorithm's class, except the activation, which is a name
    """

    source: str
    num_envs: int = 1
    normalize: bool = False
    arguments: Mapping[str, float] = {}
    policy: Mapping[str, Any] = {}


class Brax(NamedTuple):
    """Settings of brax's PPO on a task.

    source: where they stand, of which task, and what differs here
    arguments: of ``brax.training.agents.ppo.train.train``
    """

    source: str
    arguments: Mapping[str, Any]


#: The columns of PPO's settings in the zoo.
_PPO = (
    *("batch_size", "n_steps", "gamma", "learning_rate", "ent_coef", "clip_range", "n_epochs"),
    *("gae_lambda", "max_grad_norm", "vf_coef"),
)
#: The columns of brax's PPO.
_BRAX_PPO = (
    *("num_envs", "batch_size", "num_minibatches", "unroll_length", "num_updates_per_batch"),
    *("discounting", "learning_rate", "entropy_cost", "reward_scaling"),
)
_SMALL: dict[str, Any] = {}
_WIDE = {
    "log_std_init": -2,
    "ortho_init": False,
    "activation_fn": "ReLU",
    "net_arch": {"pi": [256, 256], "vf": [256, 256]},
}


def _ppo(entry: str, policy: Mapping[str, Any], *values: float) -> Sb3:
    arguments = dict(zip(_PPO, values, strict=True))
    return Sb3(f"{_ZOO.format('ppo')}, {entry}", 1, True, arguments, policy)


def _sac(entry: str, **arguments: float) -> Sb3:
    return Sb3(f"{_ZOO.format('sac')}, {entry}", arguments={"learning_starts": 10_000, **arguments})


#: What rl-baselines3-zoo tuned; its entries are of older versions of the tasks.
_TUNED: dict[str, dict[str, Sb3]] = {
    "PPO": {
        "Ant-v5": Sb3(f"{_ZOO.format('ppo')}, Ant-v4", normalize=True),
        "HalfCheetah-v5": _ppo(
            *("HalfCheetah-v4", _WIDE),
            *(64, 512, 0.98, 2.0633e-5, 0.000401762, 0.1, 20, 0.92, 0.8, 0.58096),
        ),
        "Hopper-v5": _ppo(
            *("Hopper-v4", _WIDE),
            *(32, 512, 0.999, 9.80828e-5, 0.00229519, 0.2, 5, 0.99, 0.7, 0.835671),
        ),
        "Humanoid-v5": _ppo(
            *("Humanoid-v4", _WIDE),
            *(256, 512, 0.95, 3.56987e-5, 0.00238306, 0.3, 5, 0.9, 2, 0.431892),
        ),
        "HumanoidStandup-v5": _ppo(
            *("HumanoidStandup-v2", _WIDE),
            *(32, 512, 0.99, 2.55673e-5, 3.62109e-6, 0.3, 20, 0.9, 0.7, 0.430793),
        ),
        "InvertedDoublePendulum-v5": _ppo(
            *("InvertedDoublePendulum-v2", _SMALL),
            *(512, 128, 0.98, 0.000155454, 1.05057e-6, 0.4, 10, 0.8, 0.5, 0.695929),
        ),
        "InvertedPendulum-v5": _ppo(
            *("InvertedPendulum-v2", _SMALL),
            *(64, 32, 0.999, 0.000222425, 1.37976e-7, 0.4, 5, 0.9, 0.3, 0.19816),
        ),
        "Reacher-v5": _ppo(
            *("Reacher-v2", _SMALL),
            *(32, 512, 0.9, 0.000104019, 7.52585e-8, 0.3, 5, 1.0, 0.9, 0.950368),
        ),
        "Swimmer-v5": Sb3(
            *(f"{_ZOO.format('ppo')}, Swimmer-v4", 4, True),
            {"n_steps": 1024, "batch_size": 256, "gamma": 0.9999}
            | {"learning_rate": 6e-4, "gae_lambda": 0.98},
        ),
        "Walker2d-v5": _ppo(
            *("Walker2d-v4", _SMALL),
            *(32, 512, 0.99, 5.05041e-5, 0.000585045, 0.1, 20, 0.95, 1, 0.871923),
        ),
    },
    "SAC": {
        "Ant-v5": _sac("Ant-v4"),
        "HalfCheetah-v5": _sac("HalfCheetah-v4"),
        "Hopper-v5": _sac("Hopper-v4"),
        "Humanoid-v5": _sac("Humanoid-v4"),
        "Swimmer-v5": _sac("Swimmer-v4", gamma=0.999),
        "Walker2d-v5": _sac("Walker2d-v4"),
    },
}
#: The algorithms of Stable-Baselines3 that stand beside ours.
ALGORITHMS = tuple(_TUNED)


def sb3(algorithm: str, task: str) -> Sb3:
    """Returns the zoo's settings of an algorithm on a task, or the algorithm's own defaults."""
    default = Sb3("defaults of Stable-Baselines3: rl-baselines3-zoo has no entry of the task")
    return _TUNED[algorithm].get(task, default)


def _brax(entry: str, *values: float) -> Brax:
    arguments = dict(zip(_BRAX_PPO, values, strict=True))
    return Brax(f"{_BRAX}, {entry}", {"normalize_observations": True, **arguments})


def _suite(entry: str) -> Brax:
    arguments = _brax("", 2048, 1024, 32, 30, 16, 0.995, 1e-3, 1e-2, 10).arguments
    return Brax(f"{_PLAYGROUND}, {entry}, without resets at evaluations", arguments)


#: Brax's PPO by task. For hoppers and walkers brax has settings of SAC alone.
BRAX: dict[str, Brax] = {
    "Ant-v5": _brax("ant", 4096, 2048, 32, 5, 4, 0.97, 3e-4, 1e-2, 10),
    "HalfCheetah-v5": _brax("halfcheetah", 2048, 512, 32, 20, 8, 0.95, 3e-4, 1e-3, 1),
    "Hopper-v5": _suite("HopperHop"),
    "Humanoid-v5": _brax("humanoid", 2048, 1024, 32, 10, 8, 0.97, 3e-4, 1e-3, 0.1),
    "HumanoidStandup-v5": _brax("humanoidstandup", 2048, 1024, 32, 15, 8, 0.97, 6e-4, 1e-2, 0.1),
    "InvertedDoublePendulum-v5": _brax(
        *("inverted_double_pendulum", 2048, 1024, 32, 5, 4, 0.97, 3e-4, 1e-2, 10),
    ),
    "InvertedPendulum-v5": _brax("inverted_pendulum", 2048, 1024, 32, 5, 4, 0.97, 3e-4, 1e-2, 10),
    "Pusher-v5": _brax("pusher", 2048, 512, 16, 30, 8, 0.95, 3e-4, 1e-2, 5),
    "Reacher-v5": _brax(
        "reacher, with an action for each env step in place of every fourth",
        *(2048, 256, 32, 50, 8, 0.95, 3e-4, 1e-3, 5),
    ),
    "Swimmer-v5": _suite("SwimmerSwimmer6"),
    "Walker2d-v5": _suite("WalkerRun"),
}
#: Gymnasium's MuJoCo tasks, on which the peers are trained.
TASKS = tuple(BRAX)
