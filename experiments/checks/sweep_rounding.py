"""How far does rounding move a run of a sweep when it is trained beside others, or on more devices?

``python -m experiments.checks.sweep_rounding`` trains the same 24 runs of InvertedPendulum in one
slot on one device, in two and in three slots, and on 2 and 8 (virtual) devices, and prints the
largest difference in their parameters after 1, 2, 5, 10 and 20 updates, as a share of the largest.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

#: Name -> devices, and runs in a slot.
CASES = {
    "one slot": (1, 24),
    "two slots": (1, 12),
    "three slots": (1, 8),
    "2 devices": (2, 24),
    "8 devices": (8, 24),
}
UPDATES = (1, 2, 5, 10, 20)


def train(width: int, output: Path) -> None:
    """Trains the runs, ``width`` in a slot, and keeps their parameters after each block."""
    import dataclasses

    import jax

    from mjx_reinforce import envs
    from mjx_reinforce.console.jax_setup import configure_jax
    from mjx_reinforce.devices import Devices
    from mjx_reinforce.settings.defaults import of_task
    from mjx_reinforce.sweeps.ahead import Stopwatch
    from mjx_reinforce.sweeps.chunks import initial_states, split_runs
    from mjx_reinforce.sweeps.designs.grid import configure, grid
    from mjx_reinforce.sweeps.designs.groups import learner_builder, make_groups
    from mjx_reinforce.sweeps.programs import compile_programs

    configure_jax()
    base = dataclasses.replace(
        of_task("InvertedPendulum-v5"), num_seeds=8, eval_every=1, hidden_sizes=(32, 32)
    )
    configs = configure(base, grid({"learning_rate": [3e-3, 1e-2, 3e-2]}))
    group = make_groups(configs, ["learning_rate"], exact=False)[0]
    env, devices = envs.make(base.env), Devices()
    build, traced = learner_builder(env, group.config), tuple(group.settings)
    programs = compile_programs(
        env, build, 1000, group.config, traced, (width,), devices, Stopwatch()
    )
    kept = {}
    rows = initial_states(programs, group, split_runs(group, "0", 1)[0])
    for count in range(1, max(UPDATES) + 1):
        programs.advance(rows, np.ones(24, bool), np.zeros(24), blocks=1)
        if count in UPDATES:
            states = programs.layout.states(rows)
            leaves = jax.tree.leaves(states.train_states.actor.params)
            kept[str(count)] = np.concatenate([x.reshape(24, -1) for x in leaves], axis=1)
    np.savez(output, allow_pickle=False, **kept)


def main() -> None:
    """Compares the cases with the first."""
    if len(sys.argv) > 1:
        train(int(sys.argv[1]), Path(sys.argv[2]))
        return
    folder, measured = Path(tempfile.mkdtemp(prefix="rounding-")), {}
    for name, (devices, width) in CASES.items():
        flags = (
            f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
        )
        output = folder / f"{name}.npz"
        line = [sys.executable, "-m", "experiments.checks.sweep_rounding", str(width), str(output)]
        subprocess.run(line, check=True, env=os.environ | {"XLA_FLAGS": flags.strip()})
        with np.load(output) as archive:
            measured[name] = {count: archive[count] for count in archive.files}
    whole = measured.pop("one slot")
    print("largest difference of a parameter over the largest parameter, after so many updates")
    print("| | " + " | ".join(map(str, UPDATES)) + " |\n|---|" + "---|" * len(UPDATES))
    for name, parts in measured.items():
        apart = [np.abs(parts[c] - whole[c]).max() / np.abs(whole[c]).max() for c in whole]
        print(f"| {name} | " + " | ".join(f"{x:.1e}" for x in apart) + " |")


if __name__ == "__main__":
    main()
