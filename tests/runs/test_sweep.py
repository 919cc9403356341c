"""Sweeps: the runs of ``train``, whatever is beside them, wherever they are, however they stop."""

import contextlib
import csv
import dataclasses
import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from command_lines import added_environments, run_command
from places import PYTHONPATH
from toys import Drift

import mjx_reinforce
from mjx_reinforce import envs
from mjx_reinforce import train as train_module
from mjx_reinforce.export.policy_files import load_seed
from mjx_reinforce.export.run_files import choose_seed, read_run
from mjx_reinforce.report import WrittenReport
from mjx_reinforce.reports.experiment import lengthened
from mjx_reinforce.runs import command_line, conduct, perform, plan
from mjx_reinforce.runs.design import Design, check_design, read_design
from mjx_reinforce.runs.plan import make_groups
from mjx_reinforce.runs.results import read_results
from mjx_reinforce.runs.sweep_saving import SweepFiles, join_parts
from mjx_reinforce.settings.config import Config, check
from mjx_reinforce.setup import ready
from mjx_reinforce.setup.build import build
from mjx_reinforce.training import driver, resume, slots
from mjx_reinforce.training.division import ALONE
from mjx_reinforce.training.programs import programs_of
from mjx_reinforce.training.state import StateRows


class CrashError(Exception):
    pass


SMALL = "--env Drift-v0 --num-episodes 4 --eval-episodes 2 --hidden-sizes 4 --env-steps None"
RATES = "--over learning-rate 1e-2 3e-2 1e-1"


@pytest.fixture
def run(run, monkeypatch):
    """Runs a sweep of arguments in one string; the report has tests of its own."""
    monkeypatch.setattr(perform, "_report", lambda directory: WrittenReport(0.0, [], 0))
    return lambda line, command=command_line.sweep: run(*line.split(), command=command)


def curves(directory):
    with np.load(directory / "curves.npz", allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def same(one, other):
    return all(np.array_equal(one[name], other[name], equal_nan=True) for name in one | other)


def close(one, other):
    """As near as rounding leaves runs of few updates."""
    return all(np.allclose(one[n], other[n], rtol=1e-4, equal_nan=True) for n in one | other)


@pytest.mark.slow
def test_a_run_is_that_of_train(run):
    """Of whichever configuration and group, with a std of its own, and with the starts of its seed.

    All policies of a seed are alike at first, so that its first evaluations tell the starts.
    """
    over = "--over learning-rate 1e-2 3e-2 --over estimator leave-one-out total-return "
    over += "--over initial-std 0.4 0.6 --over decay-steps 40 4000"
    shared = f"{SMALL} --num-seeds 2 --max-updates 6 --max-kl 0.01 --final-std 0.1"
    assert run(f"{shared} {over} --output swept") == 0
    results = read_results(Path("swept"))
    assert len(results.configurations) == 16
    assert results.configurations[10] == {
        "learning_rate": 3e-2,
        "estimator": "leave-one-out",
        "initial_std": 0.6,
        "decay_steps": 40,
    }
    alone = "--learning-rate 3e-2 --initial-std 0.6 --decay-steps 40 --output alone"
    assert run(f"{shared} {alone}", train_module.main) == 0
    rows = list(csv.DictReader(Path("alone/metrics.csv").read_text().splitlines()))
    for name in ("eval_return", "env_steps"):
        expected = np.array([float(row[name]) for row in rows]).reshape(-1, 2)
        measured = getattr(results, name)[:, results.configuration == 10]
        assert np.allclose(measured, expected, rtol=1e-4, equal_nan=True)
    assert not same({"": results.eval_return[:, :2]}, {"": results.eval_return[:, 20:22]})
    assert not same({"": results.eval_return[:, 20:22]}, {"": results.eval_return[:, 22:24]})
    first = results.eval_return[0]
    assert all(len(set(first[results.seed == seed])) == 1 for seed in range(2))
    assert len(set(first)) == 2


@pytest.mark.slow
def test_the_files_and_the_screen_say_what_was_measured(run, capsys):
    command = f"{SMALL} --num-seeds 2 --max-updates 7 --over hidden-sizes none 3,3 {RATES}"
    assert run(f"{command} --output swept") == 0
    said = capsys.readouterr().out.splitlines()
    headings = [i for i, line in enumerate(said) if line.endswith(" of 6, 6 runs)")]
    assert [said[i] for i in headings] == [
        f"hidden sizes {layers}; learning rate 0.01, 0.03, 0.1 (3 configurations of 6, 6 runs)"
        for layers in ("none", "3-3")
    ]
    assert all(said[i + 1].startswith("update ") for i in headings)
    measured = curves(Path("swept"))
    assert [*zip(measured["configuration"], measured["seed"], strict=True)] == [
        (c, s) for c in range(6) for s in range(2)
    ]
    assert measured["nonfinite"].shape == (12,)
    said = json.loads(Path("swept/sweep.json").read_text())
    assert said["status"] == "finished"
    assert said["configurations"][4] == {
        "configuration": 4,
        "hidden_sizes": [3, 3],
        "learning_rate": 3e-2,
    }
    assert len(said["chunk_runs"]) == 2  # two networks, two programs


@pytest.mark.slow
def test_an_exact_run_does_not_depend_on_the_others(run):
    """Neither on its chunk, nor on what is swept beside it, nor on the seeds of its share."""
    command = f"{SMALL} --env-steps 300 --eval-every 1 --initial-std 2 --exact"
    assert run(f"{command} --num-seeds 3 {RATES} --output whole") == 0
    more = "--over learning-rate 3e-2 1e-1 --over discount 0.9 0.99 --chunk-runs 2 --seeds 1:3"
    assert run(f"{command} {more} --output share") == 0
    whole, share = read_results(Path("whole")), read_results(Path("share"))
    assert set(share.seed.tolist()) == {1, 2}
    assert len(set(whole.env_steps.argmax(axis=0).tolist())) > 2  # they end one by one
    length = max(len(whole.env_steps), len(share.env_steps))
    for one, other in ((1, 1), (2, 3)):  # 0.99 is the default discount
        here, there = (whole.configuration == one) & (whole.seed > 0), share.configuration == other
        for name in ("eval_return", "env_steps"):
            found, expected = getattr(share, name)[:, there], getattr(whole, name)[:, here]
            np.testing.assert_array_equal(*(lengthened(x, length) for x in (found, expected)))


@pytest.mark.slow
def test_numbers_of_shifts_dampings_and_values_are_traced(monkeypatch):
    """As arguments of one program, side by side, they do what they do alone."""
    base = dataclasses.replace(
        Config(env="Drift-v0"),
        estimator="value-baseline",
        value_fits=1,
        value_hidden_sizes=(4,),
        value_batch_size=16,
        update="natural-gradient",
        max_kl=1e-2,
        num_episodes=4,
        hidden_sizes=(4,),
        engine="vmap",
    )
    swept = {"entropy_cost": [0.0, 0.5], "standardize_floor": [0.1, 1.0]}
    design = Design(base=base, over=swept, exact=True)
    (group,) = make_groups(design)
    assert {"entropy_cost", "standardize_floor", "max_kl", "value_learning_rate"} <= {
        *group.settings
    }
    key = jax.random.key(3)
    monkeypatch.setattr(ready, "programs_of", lambda env, build, *more, **options: build)
    builder = ready.build_ready(Drift(), group.config, ALONE, tuple(group.settings)).programs()

    def trained(learner):
        states = jax.lax.scan(lambda x, _: (learner.step(x)[0], None), learner.init(key), None, 2)
        return states[0].actor.params

    together = jax.jit(jax.vmap(lambda settings: trained(builder(settings))))(group.settings)
    found = []
    for number, config in enumerate(design.configs):
        alone = jax.jit(lambda config=config: trained(build(Drift(), config).learner))()
        jax.tree.map(
            lambda x, y, number=number: np.testing.assert_allclose(x[number], y, atol=1e-4),
            together,
            alone,
        )
        found.append(np.concatenate([np.ravel(x) for x in jax.tree.leaves(alone)]))
    assert np.abs(found[0] - found[-1]).max() > 1e-3


#: Runs end one by one, for the noisier their actions are the shorter are their episodes.
STEPS = f"{SMALL} --env-steps 300 --decay-steps 280000 --eval-every 1 --over initial-std 0.3 1 3"
#: Of four runs a chunk, in slots of four and of one.
CHUNKS = f"{STEPS} --num-seeds 4 --chunk-runs 4 --checkpoint-every 1"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A sweep of chunks that nothing stopped."""
    directory = tmp_path_factory.mktemp("sweep")
    with pytest.MonkeyPatch.context() as patch, contextlib.chdir(directory), added_environments():
        patch.setattr(perform, "_report", lambda directory: WrittenReport(0.0, [], 0))
        patch.setattr(plan, "_CPU_EPISODES", 16)
        assert run_command(*CHUNKS.split(), "--output", "whole", command=command_line.sweep) == 0
    return directory / "whole"


def in_place(chosen, lengths, width, num_devices):
    """A packing that leaves all runs in their lanes until the last has ended."""
    del lengths, num_devices
    lanes = np.full(-(-len(chosen) // width) * width, -1)
    lanes[: len(chosen)] = np.arange(len(chosen))
    return lanes.reshape(-1, width)


@pytest.mark.slow
@pytest.mark.cpu
def test_packing_changes_nothing(run, monkeypatch):
    """Neither which runs share a slot, nor that those that ended lie aside."""
    # With this seed one run trains last, alone.
    command = f"{STEPS} --num-seeds 4 --seed 2"
    shapes, packing = [], slots.pack_slots

    def packed(*arguments):
        shapes.append(packing(*arguments).shape)
        return packing(*arguments)

    monkeypatch.setattr(plan, "_CPU_EPISODES", 16)
    monkeypatch.setattr(slots, "pack_slots", packed)
    assert run(f"{command} --output packed") == 0
    assert shapes[0] == (3, 4)
    assert shapes[-2] == (1, 4)
    assert shapes[-1] == shapes[0]  # the last policies of all are evaluated together
    assert set(shapes) == {(3, 4), (2, 4), (1, 4)}
    monkeypatch.setattr(plan, "_CPU_EPISODES", 48)
    monkeypatch.setattr(slots, "pack_slots", in_place)
    assert run(f"{command} --output wide") == 0
    one, other = curves(Path("packed")), curves(Path("wide"))
    assert len(set(one["env_steps"][-1])) > 6
    assert close(one, other)


@pytest.mark.slow
def test_blocks_without_a_pause_change_nothing(run, monkeypatch):
    """Runs that one slot holds make several blocks before the host looks at them."""
    command = f"{STEPS} --num-seeds 2"
    monkeypatch.setattr(plan, "_CPU_EPISODES", 24)
    made, advance = [], slots.Slots.advance

    def counted(*arguments, **options):
        blocks = advance(*arguments, **options)
        made.append(len(blocks))
        return blocks

    monkeypatch.setattr(slots.Slots, "advance", counted)
    monkeypatch.setattr(driver, "_CALL_SECONDS", 60.0)
    assert run(f"{command} --output several") == 0
    assert made[:4] == [1, 2, 4, 8]
    several, total = curves(Path("several")), sum(made)
    monkeypatch.setattr(driver, "_CALL_SECONDS", 0.0)
    made.clear()
    assert run(f"{command} --output each") == 0
    assert set(made) == {1}
    assert len(made) == total == len(several["env_steps"]) - 1
    assert same(several, curves(Path("each")))


@pytest.mark.slow
def test_a_sweep_goes_on_wherever_it_stops(run, whole, monkeypatch, capsys):
    """Before a first update, among runs that ended, after a chunk, and with a full disk.

    What ended is not trained again, and its report is written if it is not there.
    """
    monkeypatch.setattr(plan, "_CPU_EPISODES", 16)
    drive, driven, ended, tried = driver.Driver.drive, [], [], []
    add, save, write = SweepFiles._write_part, SweepFiles._save_checkpoint, resume.save

    def interrupted(*arguments):
        driven.append(None)
        if len(driven) == 1:
            drive(*arguments)

    def crash_among_ended(self, driver):
        save(self, driver)
        ended.append((driver.record.env_steps >= 300).sum())
        if 0 < ended[-1] < 4:
            raise CrashError

    def crash_after_chunk(*arguments):
        add(*arguments)
        raise CrashError

    def full(*arguments, **options):
        tried.append(None)
        if len(tried) in (1, 2, 4):
            raise OSError(errno.ENOSPC, "No space left on device")
        write(*arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(driver.Driver, "drive", interrupted)
        assert run(f"{CHUNKS} --output parts") == 0
    assert json.loads(Path("parts/sweep.json").read_text())["status"] == "interrupted"
    for name, crash in (
        ("_save_checkpoint", crash_among_ended),
        ("_write_part", crash_after_chunk),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(SweepFiles, name, crash)
            with pytest.raises(CrashError):
                run("--resume parts")
    assert 0 < ended[-1] < 4
    assert json.loads(Path("parts/sweep.json").read_text())["status"] == "running"
    assert len(list(Path("parts/parts").glob("[0-9]*.npz"))) == 2
    capsys.readouterr()
    monkeypatch.setattr(resume, "save", full)
    assert run("--resume parts") == 0
    assert len(tried) > 4
    said = capsys.readouterr().out
    assert said.count("warning: cannot write a checkpoint (No space left on device)") == 2
    assert same(curves(whole), curves(Path("parts")))
    reported, written = [], WrittenReport(1.0, [], 0)
    monkeypatch.setattr(perform, "_report", lambda directory: reported.append(directory) or written)
    assert run("--resume parts") == 0  # killed before the report was written
    assert reported == [Path("parts")]
    Path("parts/report.html").touch()
    monkeypatch.setattr("mjx_reinforce.runs.perform.configure_jax", pytest.fail)
    assert run("--resume parts") == 0  # there is nothing left to do
    assert reported == [Path("parts")]
    assert run("--resume parts --learning-rate 0.5") == 2


OTHER_PARTS = {
    "eval_return": (lambda x: x[:, :1], ", 1], not float32["),
    "env_steps": (None, "env_steps is missing"),
    "seed": (lambda x: x + 1, "seed is that of other runs"),
    "configuration": (lambda x: x.astype(float), "configuration is float64[4], not int32[4]"),
    "ends/seed": (lambda x: x[1:], "its ends are not of as many runs as their policies"),
    "ends/normalizer/mean": (lambda x: x[..., :0], "and the settings of the policy make it"),
}


@pytest.mark.slow
def test_a_part_of_other_runs_is_named_before_anything_is_trained(run, monkeypatch, capsys):
    monkeypatch.setattr(plan, "_CPU_EPISODES", 16)

    def crash_after_chunk(*arguments):
        add(*arguments)
        raise CrashError

    add = SweepFiles._write_part
    with monkeypatch.context() as patch:
        patch.setattr(SweepFiles, "_write_part", crash_after_chunk)
        with pytest.raises(CrashError):
            run(f"{CHUNKS} --output parts")
    (part,) = Path("parts/parts").glob("[0-9]*.npz")
    with np.load(part) as archive:
        arrays = dict(archive)
    monkeypatch.setattr(driver.Driver, "drive", lambda *_: pytest.fail("it is trained"))
    for name, (change, said) in OTHER_PARTS.items():
        others = {key: x for key, x in arrays.items() if key != name}
        if change is not None:
            others[name] = change(arrays[name])
        np.savez(part, **others)
        capsys.readouterr()
        assert run("--resume parts") == 2
        error = capsys.readouterr().err
        assert f"{part} is damaged: " in error
        assert said in error
        assert error.count("\n") == 1


@pytest.mark.slow
def test_a_chunk_that_goes_on_saves_when_it_is_due(run, monkeypatch):
    """Not at its first look: the checkpoint that it was found in counts."""
    monkeypatch.setattr(driver, "_CALL_SECONDS", 0.0)
    command = f"{SMALL} --num-seeds 2 --eval-every 1 --checkpoint-every 2 {RATES}"
    save, saved = SweepFiles._save_checkpoint, []

    def crash(self, driver):
        save(self, driver)
        saved.append(driver.updates())
        if saved == [2]:
            raise CrashError

    monkeypatch.setattr(SweepFiles, "_save_checkpoint", crash)
    with pytest.raises(CrashError):
        run(f"{command} --max-updates 5 --output crashed")
    assert run("--resume crashed") == 0
    assert saved == [2, 4]


def start(count, command, folder):
    """Starts a sweep in a process that has so many devices."""
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={count}"
    environment = os.environ | {"XLA_FLAGS": flags, "PYTHONPATH": PYTHONPATH}
    line = [sys.executable, "-m", "mjx_reinforce.sweep", *command.split()]
    return subprocess.Popen(line, cwd=folder, env=environment, stdout=subprocess.DEVNULL)


@pytest.mark.slow
@pytest.mark.cpu
def test_devices_change_nothing_but_rounding(run, tmp_path):
    command = f"{STEPS} --num-seeds 3"
    assert run(f"{command} --output one") == 0
    elsewhere = command.replace("Drift-v0", "toys:Drift")
    assert start(2, f"{elsewhere} --output two", tmp_path).wait(timeout=120) == 0
    assert close(curves(tmp_path / "one"), curves(tmp_path / "two"))


@pytest.mark.slow
def test_a_sweep_whose_first_file_cannot_be_written_was_not_begun(run, monkeypatch):
    """The same command line begins it once there is room."""

    def full(path, contents):
        raise OSError(errno.ENOSPC, "No space left on device")

    command = f"{STEPS} --num-seeds 2 --output out"
    with monkeypatch.context() as patch:
        patch.setattr("mjx_reinforce.runs.saving.write_json", full)
        assert run(command) == 1
    Path("out").mkdir(exist_ok=True)
    (Path("out") / ".sweep.json.12ab").write_text("half")
    monkeypatch.setattr(conduct, "compile_slots", lambda *_: pytest.fail("it begins"))
    with pytest.raises(pytest.fail.Exception, match="it begins"):
        run(command)


def test_what_a_kill_left_of_a_report_goes(tmp_path, monkeypatch):
    """A write that was killed leaves a file with a name of its own."""
    (tmp_path / "report").mkdir()
    left = [tmp_path / ".report.html.12ab", tmp_path / "report" / ".final.png.8f95"]
    for path in left:
        path.write_text("half")
    nothing = WrittenReport(0.0, [], 0)
    monkeypatch.setattr("mjx_reinforce.report.write_report", lambda chosen, output: nothing)
    assert perform._report(tmp_path) == nothing
    assert not any(path.exists() for path in left)


def test_what_ended_earlier_repeats_its_last_row():
    one = {"configuration": np.array([1, 0]), "seed": np.array([0, 0]), "eval_return": np.eye(2)}
    other = {"configuration": np.array([0]), "seed": np.array([1])}
    joined = join_parts([one, other | {"eval_return": np.full((3, 1), 7.0)}])
    assert joined["configuration"].tolist() == [0, 0, 1]
    assert joined["seed"].tolist() == [0, 1, 0]
    assert joined["eval_return"].tolist() == [[0, 7, 1], [1, 7, 0], [1, 7, 0]]


def test_numbers_share_a_program_and_the_rest_does_not():
    over = {"learning_rate": [1e-3, 1e-2], "max_grad_norm": [1.0, None, 2.0]}
    groups = make_groups(Design(base=Config(), over=over))
    assert [group.members.tolist() for group in groups] == [[0, 2, 3, 5], [1, 4]]
    assert groups[0].settings["max_grad_norm"].tolist() == [1.0, 2.0, 1.0, 2.0]
    # Left alone, it follows the first rate.
    assert np.allclose(groups[1].settings["final_learning_rate"], [1e-4, 1e-3])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "nothing is swept"),
        ("--over learning-rate", "needs two values or more"),
        ("--over learning-rate 1e-3", "for one value pass --learning-rate"),
        ("--over learning-rate 1e-3 1e-3", "has the value 0.001 twice"),
        ("--over learning-rate 1e-3 -1", "--learning-rate must be positive"),
        ("--over seed 1 2", "cannot go over seed"),
        ("--over value-learning-rate 1e-3 1e-2", "would do nothing"),
        ("--over learning-rate 1e-2 1e-3 --value-fits 3", "--value-fits 3 would do nothing"),
        ("--env CartPole-v1 --over initial-std 0.1 0.5", "--initial-std 0.1 would do nothing"),
        ("--env CartPole-v1 --initial-std 0.3 --over learning-rate 1 2", "-std 0.3 would do"),
        ("--over learning-rate 1e-2 1e-3 --chunk-runs 0", "--chunk-runs must be at least 1"),
        ("--over learning-rate 1e-2 1e-3 --log wandb", "--log logs a run"),
        ("--update natural-gradient --over max-kl None 0.1", "from --max-kl, which is None"),
        ("--over learning-rate 1 2 --num-seeds 2000000000", "results of 4,000,000,000 runs do not"),
        ("--resume nowhere", "there is no config.json or sweep.json"),
    ],
)
def test_bad_sweeps_are_refused(run, capsys, tmp_path, monkeypatch, arguments, message):
    monkeypatch.setattr(conduct, "compile_slots", lambda *_: pytest.fail("it was compiled"))
    assert run(f"--env Drift-v0 {arguments}") == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert printed.err.count("\n") == 1
    assert printed.out == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("base", "over"),
    [
        ({"update": "natural-gradient"}, {"max_kl": [0.01, 0.1]}),
        ({"env_steps": None}, {"max_updates": [1, 2]}),
        ({"num_episodes": 1}, {"estimator": ["reward-to-go", "total-return"]}),
    ],
)
def test_what_every_configuration_sets_need_not_be_given_besides(base, over):
    config = Config(env="CartPole-v1", **base)
    with pytest.raises(ValueError, match=r"--max-kl|nothing would end|leave-one-out"):
        check(config)
    check_design(Design(base=config, over=over))


def test_a_flag_that_one_configuration_reads_is_accepted():
    over = {"estimator": ["leave-one-out", "value-baseline"]}
    check_design(Design(base=Config(value_fits=3), over=over, default=Config()))
    rates = {"final_learning_rate": [1e-3, 1e-2]}
    with pytest.raises(ValueError, match="would do nothing"):
        check_design(Design(base=Config(decay_steps=None), over=rates))


@pytest.mark.slow
def test_from_python_it_is_reported_on(register, monkeypatch, tmp_path, capsys):
    written = WrittenReport(1.5, ["The best is learning rate 0.03.", "It is sure."], 1)
    monkeypatch.setattr(perform, "_report", lambda directory: written)
    base = Config(
        env="Drift-v0", num_seeds=2, num_episodes=4, eval_episodes=2, env_steps=None, max_updates=2
    )
    results = mjx_reinforce.sweep(base, {"learning_rate": [1e-2, 3e-2]}, output=tmp_path / "out")
    assert results.eval_return.shape[1] == 4
    said = capsys.readouterr().out
    assert "statistics and report 1.5 s" in said
    assert "The best is learning rate 0.03.\nIt is sure.\n" in said
    assert f"mjx_reinforce.watch {tmp_path}/out/policies/001\n" in said
    assert (tmp_path / "out/policies/001/config.json").is_file()


@pytest.mark.slow
def test_the_policies_of_the_best_and_the_worst_seed_are_kept(run):
    """To the bit: played on the starts of the sweep's evaluations they return what it measured."""
    command = f"{SMALL} --num-seeds 5 --chunk-runs 6 --max-updates 6 {RATES} --output swept"
    assert run(command) == 0
    results, env = read_results(Path("swept")), envs.make("Drift-v0")
    assert not Path("swept/parts").exists()
    for number in range(3):
        chosen = results.configuration == number
        final, seeds = results.eval_return[-1, chosen], results.seed[chosen]
        folder = Path(f"swept/policies/{number:03d}")
        known = read_run(folder)
        ranked = np.nan_to_num(final, nan=-np.inf)  # a broken evaluation is the worst
        worst, best = int(seeds[ranked.argmin()]), int(seeds[ranked.argmax()])
        assert known.seeds == tuple(sorted({worst, best}))
        assert choose_seed(known, "worst") == worst
        assert choose_seed(known, "best") == best
        config = Config(env="Drift-v0", num_seeds=5, eval_episodes=2, hidden_sizes=(4,))
        learner, *horizons, _ = build(env, config)
        made = programs_of(env, lambda _, x=learner: x, *horizons, config, 1, all_metrics=False)
        evaluate, layout = jax.jit(made.evaluate), StateRows(made.like)
        for seed in known.seeds:
            actor = jax.tree.map(lambda x: x[None], load_seed(known, seed)[0].actor)
            rows, _ = jax.jit(made.begin)(0, np.array([seed], np.uint32), {})
            states = layout.states(np.asarray(rows))
            trained = states.train_states.replace(actor=actor)
            rows = layout.rows(states.replace(train_states=trained))
            returns = evaluate(rows, np.ones(1, bool))["eval_return"]
            np.testing.assert_array_equal(returns[0], final[seeds == seed][0])
    with pytest.raises(ValueError, match="has the policies of the seeds"):
        load_seed(read_run(Path("swept/policies/000")), 99)


@pytest.mark.slow
def test_each_setting_of_an_environment_has_its_own_program_and_policies(tmp_path, capsys):
    """With this reward CartPole earns 1 a step, or nothing until it falls."""
    base = Config(
        env="CartPole-v1",
        engine="vmap",
        hidden_sizes=(4,),
        num_seeds=2,
        num_episodes=2,
        eval_episodes=2,
        env_steps=None,
        max_updates=2,
        env_set=("max_episode_steps=9",),
    )
    over = {"env_set.sutton_barto_reward": ["false", "true"]}
    found = mjx_reinforce.sweep(base, over, output=tmp_path / "out", report=False, quiet=True)
    assert capsys.readouterr().out == ""
    assert not (tmp_path / "out" / "report.html").exists()
    last = found.eval_return[-1]
    assert np.all(last[found.configuration == 0] > 5)
    assert np.all(last[found.configuration == 1] <= 0)
    run = read_run(tmp_path / "out" / "policies" / "001")
    assert run.env_set == ("max_episode_steps=9", "sutton_barto_reward=true")
    assert run.horizon == 9
    resumed = read_design(tmp_path / "out")
    assert (resumed.base, resumed.over) == (
        dataclasses.replace(base, resume=tmp_path / "out"),
        over,
    )


@pytest.mark.slow
def test_each_horizon_is_evaluated_to_its_own_end(tmp_path, monkeypatch):
    """Where evaluations are calls of their own; the episodes here earn 1 a step."""
    shape = {"num_seeds": 2, "num_episodes": 2, "eval_episodes": 2}
    config = Config(env="toys:Survive", engine="vmap", **shape)
    config = dataclasses.replace(config, max_updates=1, env_steps=None)
    monkeypatch.chdir(tmp_path)
    found = mjx_reinforce.sweep(config, over={"horizon": [5, 20]})
    assert found.directory is None
    assert [*tmp_path.iterdir()] == []
    ended = dict(zip(found.configuration.tolist(), found.eval_return[-1].tolist(), strict=True))
    assert ended == {0: 5.0, 1: 20.0}
