"""The results page: its statistics, and what it says of made-up runs with a known answer."""

import csv
import dataclasses
import json
import math
import tarfile

import numpy as np
import pytest
from PIL import Image

from experiments.studies.results import files, films
from experiments.studies.results import page as results_page
from experiments.studies.results import runs as results_runs
from experiments.studies.results.measures import (
    compare,
    curves,
    least_share_solved,
    published_interval,
    solved_within,
    steps_quantile,
    verdict,
)
from experiments.studies.results.tasks import TASKS, settings_of, sweep_settings_of
from experiments.studies.tuning import __main__ as tuning
from mjx_reinforce.export.run_files import read_run
from mjx_reinforce.files import read_json
from mjx_reinforce.reports.statistics import Estimate, iqm
from mjx_reinforce.runs import command_line
from mjx_reinforce.settings.config import Config, check
from mjx_reinforce.sweeps.designs.design import check_design

PENDULUM, REACHER = TASKS["InvertedPendulum-v5"], TASKS["Reacher-v5"]


def test_published_interval_is_students():
    assert published_interval(10.0, 1.0) == pytest.approx((10, 10 - 0.715357, 10 + 0.715357))


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(10.72, 12, "above"), (10.71, 12, "not apart"), (8, 9.28, "below"), (8, 9.29, "not apart")],
)
def test_verdict_asks_whether_the_intervals_overlap(low, high, expected):
    assert verdict(Estimate((low + high) / 2, low, high), (10.0, 1.0)) == expected


def test_verdict_without_figures():
    assert verdict(Estimate(1.0, 0.0, 2.0), None) == "none published"
    assert verdict(Estimate(math.nan, math.nan, 2.0), (0.0, 1.0)) == "none: a seed failed"
    assert verdict(Estimate(1000.0, math.nan, math.nan), (900.0, 1.0)) == "no interval"
    assert verdict(Estimate(1000.0, math.nan, math.nan), (1000.0, 0.0)) == "not apart"


def test_steps_to_solve_count_seeds_that_never_did():
    steps = [10.0, 30.0, 20.0, math.inf]
    assert [solved_within(steps, limit) for limit in (9, 10, 20, 1e9)] == [0, 1, 2, 3]
    assert [steps_quantile(steps, share) for share in (0.25, 0.5, 0.51, 0.75)] == [10, 20, 30, 30]
    assert steps_quantile(steps, 0.99) == math.inf


#: Two seeds, evaluated at other steps: the first falls from 40 to 60, the second solves at 30.
RETURNS = np.array([[0, 0], [9, 0], [1, 9], [9, 9], [9, np.nan], [9, 9]], float)
STEPS = np.array([[0, 0], [20, 10], [40, 30], [60, 70], [80, 90], [100, 110]])


@pytest.mark.parametrize(
    ("start", "stop", "expected"),
    [(0, 100, 0), (35, 39, 1), (30, 45, 0.5), (20, 29, 0.5), (60, 89, 1), (60, 90, 0.5)],
)
def test_least_share_solved_is_of_the_last_evaluations(start, stop, expected):
    assert least_share_solved(RETURNS, STEPS, 5.0, start, stop) == expected


def test_least_share_solved_needs_a_run_as_long():
    assert math.isnan(least_share_solved(RETURNS, STEPS, 5.0, 0, 111))
    assert least_share_solved(RETURNS, STEPS, 5.0, 105, 110) == 0.5


def test_curves_are_over_seeds_at_the_same_steps():
    seeds, last = np.arange(8.0), 100
    steps = np.array([[0] * 8, [50] * 8, [last] * 8])
    found = curves(seeds * steps, steps, threshold=last * 5.5, budget=last)
    np.testing.assert_allclose(found["q50"], 3 * found["env_steps"])
    np.testing.assert_allclose(found["q75"], 5 * found["env_steps"])
    np.testing.assert_allclose(found["iqm"], iqm(seeds) * found["env_steps"])
    assert np.all(((found["low"] < found["iqm"]) & (found["iqm"] < found["high"]))[1:])
    assert found["env_steps"][-1] == last
    np.testing.assert_allclose(found["solved"][[0, -2, -1]], [0, 0, 0.25])


def test_a_failed_seed_is_the_worst_of_a_curve():
    returns = np.array([[1, 2, 3, 4], [1, 2, 3, np.nan]])
    found = curves(returns, np.array([[0] * 4, [10] * 4]), None, 10)
    assert (found["q0"][-1], found["q100"][-1], found["q75"][-1]) == (-math.inf, 3.0, 2.0)
    assert np.isnan(found["solved"]).all()


def test_a_seed_that_ended_before_keeps_its_return():
    returns, steps = np.array([[0, 0], [6, 1]]), np.array([[0, 0], [60, 10]])
    found = curves(returns, steps, None, 50)
    assert found["env_steps"][-1] == 50
    np.testing.assert_allclose([found["q0"][-1], found["q100"][-1]], [1, 5])


def test_compare_tells_simulations_apart():
    same = compare([1000.0] * 5, [1000.0] * 5)
    assert same.within
    assert np.isnan(same.difference).tolist() == [False, True, True]
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(0, 1, 100), rng.normal(1, 1, 100)
    other = compare(ours, theirs)
    assert not other.within
    assert 0 < other.difference.low < 1 < other.difference.high


def test_each_setting_moves_alone():
    base = Config(
        num_seeds=2,
        learning_rate=0.3,
        discount=0.99,
        num_episodes=16,
        initial_std=0.6,
        standardize=False,
        decay_steps=None,
        max_kl=None,
        momentum=0.7,
    )
    moves = results_runs.moves(base)
    assert set(moves) == {"learning_rate", "discount", "num_episodes", "initial_std", "momentum"}
    assert moves["learning_rate"] == pytest.approx([0.1, 0.3, 0.9])
    assert moves["discount"] == pytest.approx([0.97, 0.99, 1 - 0.01 / 3])
    assert moves["momentum"] == pytest.approx([0.1, 0.7, 0.9])
    assert moves["num_episodes"] == [5, 16, 48]
    configurations = results_runs.OneAtATime(base=base, over=moves).configurations()
    changed = [sum(one[k] != configurations[0][k] for k in one) for one in configurations]
    assert changed == [0] + [1] * 10
    assert configurations[0] == {name: getattr(base, name) for name in moves}
    undiscounted = results_runs.moves(dataclasses.replace(base, discount=1.0))
    assert "discount" not in undiscounted


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_the_stages_have_settings_that_hold(task, tmp_path):
    words = results_runs.command(task, tmp_path / task.name)
    config = command_line.parse(words[3:])
    wanted = settings_of(task, task.seeds, task.env_steps)
    assert config == dataclasses.replace(wanted, output=tmp_path / task.name)
    check(config)
    base = sweep_settings_of(task, task.sweep_seeds, task.sweep_steps)
    check_design(results_runs.OneAtATime(base=base, over=results_runs.moves(base)))


SEARCHES = read_json(tuning.KEPT / "searches.json")


@pytest.mark.parametrize("name", SEARCHES)
def test_a_search_can_be_made_again(name, tmp_path):
    """With the configurations that were kept, and no more memory than they need."""
    design = tuning._design(SEARCHES[name], tmp_path)
    check_design(design)
    base = dataclasses.asdict(design.base)
    kept = SEARCHES[name]["configurations"]
    pairs = zip(design.configurations(), kept, strict=True)
    assert [{k: (base | one)[k] for k in values} for one, values in pairs] == kept
    assert (tuning.KEPT / f"{name}.csv").exists()


def test_a_run_that_was_begun_goes_on(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    assert results_runs.command(PENDULUM, tmp_path)[3:] == ["--resume", str(tmp_path)]


def write_run(directory, task, returns, threshold):
    """Writes what a run of straight curves to final returns [S] leaves; ``page`` reads it."""
    directory.mkdir(parents=True)
    config = json.loads(json.dumps(dataclasses.asdict(settings_of(task, len(returns), 1_000_000))))
    config |= {"horizon": 1000, "device": "cpu", "num_devices": 1, "cpu_count": 2}
    config |= {"git_commit": "0123456789abcdef", "packages": {"jax": "0.10.2"}}
    (directory / "config.json").write_text(json.dumps(config))
    summary = {"status": "finished", "threshold": threshold, "engine": "native"}
    summary |= {"num_seeds": len(returns), "compile_seconds": 9.0, "run_seconds": 600.0}
    summary["final_test_returns"] = [490.0 if x == 500.0 else x for x in returns]
    (directory / "summary.json").write_text(json.dumps(summary | {"nonfinite": []}))
    with (directory / "metrics.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("seed", "env_steps", "eval_return"))
        for steps in range(0, 1_000_001, 20_000):
            for seed, final in enumerate(returns):
                writer.writerow((seed, steps, final * min(1, steps / 100_000)))


def write_sweep(directory, task):
    """Writes a sweep in which a third of the learning rate is worse, and nothing else matters."""
    directory.mkdir(parents=True)
    base = settings_of(task, 16, 1000)
    design = results_runs.OneAtATime(base=base, over=results_runs.moves(base))
    values = design.configurations()
    configuration = np.repeat(np.arange(len(values)), 16)
    slow = np.array([one["learning_rate"] < base.learning_rate for one in values])
    final = np.where(slow[configuration], 100.0, 1000.0)
    arrays = {"configuration": configuration, "seed": np.tile(np.arange(16), len(values))}
    shown = np.stack([np.zeros(len(final)), final])
    steps = np.stack([np.zeros(len(final)), np.where(final < 1000, 900, 1000)])
    np.savez(directory / "curves.npz", eval_return=shown, env_steps=steps, **arrays)
    record = {"status": "finished", "threshold": 950.0, "settings": {"env_steps": 1000}}
    record["configurations"] = [{"configuration": i} | one for i, one in enumerate(values)]
    (directory / "sweep.json").write_text(json.dumps(record))


@pytest.fixture
def kept(tmp_path):
    """The folder of small files of two tasks, one of them swept and played."""
    runs = tmp_path / "runs"
    write_run(runs / PENDULUM.name, PENDULUM, [1000.0] * 9 + [500.0], 950.0)
    write_run(runs / REACHER.name, REACHER, [-4.0, -4.1, -4.2, -4.3, -4.0, -4.1], -3.75)
    write_sweep(runs / "sensitivity" / PENDULUM.name, PENDULUM)
    rows = [
        {"policy": policy, "seed": 3, "simulation": name, "episode": i, "return": value + i % 2}
        for policy in files.POLICIES
        for name, value in (("ours", 998), ("gymnasium 1.4.0", 998 if policy == "best" else 900))
        for i in range(20)
    ]
    files.write_played(runs / "play" / f"{PENDULUM.name}.csv", rows)
    files.gather(TASKS.values(), runs, tmp_path / "kept")
    return tmp_path / "kept"


def test_the_page_says_what_was_measured_and_what_is_missing(kept, tmp_path):
    parts = files.load(TASKS.values(), kept)
    docs = tmp_path / "docs"
    (docs / "films").mkdir(parents=True)
    (docs / "films" / f"{PENDULUM.name}-best.gif").touch()
    results_page.write(parts, docs)
    page = (docs / "results.md").read_text("utf-8")
    lines = page.splitlines()
    row = next(line for line in lines if line.startswith(f"| {PENDULUM.name} | 10 |"))
    assert "| 1,000,000 | 1,000.0 (" in row
    assert "| 490.0 | 9 of 10 (950) | 1,000.0 (no interval) |" in row
    assert "| 10.0 min, 9.0 s | 2 CPU cores | 998.5, 900.5 |" in row
    assert f"above the published figure: {REACHER.name}\n" in page
    (missing,) = [line for line in lines if line.startswith("Not run yet: ")]
    assert all(name in missing for name in TASKS if name not in (PENDULUM.name, REACHER.name))
    assert f"{REACHER.name}," not in missing
    assert "| linear | 10 | 0.00 % (0) | 90.00 % (9) | 90.00 % | 100,000 | never |" in lines
    assert f"  they: 16 ({PENDULUM.name}) and 256 ({REACHER.name}).\n" in page
    assert f"starts out: {PENDULUM.name}." in page  # of its sweep, made up without a test
    assert f"Not played yet: {REACHER.name}." in page
    assert "Of 2 policies, 1 have" in page
    assert f"[film](films/{PENDULUM.name}-best.gif)" in page
    assert f"-{files.POLICIES[1]}.gif" not in page
    assert f"since their episodes stayed short: {PENDULUM.name} 16 of " in page
    rate = settings_of(PENDULUM, 1, 1).learning_rate / 3
    assert f"| 16 | 1,000 | solved 100.0 % | learning rate {rate:.6g}: 0.0 % | none |" in page
    pictures = sorted(path.name for path in (docs / "results").iterdir())
    assert pictures == ["curves.png", "sensitivity.png"]


def test_what_is_packed_elsewhere_gives_the_same_page(kept, tmp_path):
    """And the policies can be played; what is not needed stays behind."""
    runs, here = tmp_path / "runs", tmp_path / "here"
    tasks = [PENDULUM, REACHER, TASKS["Ant-v5"]]
    for task in tasks[:2]:
        (runs / task.name / "policy").mkdir()
        for name in ("policy.json", "actor.npz"):
            (runs / task.name / "policy" / name).write_text(task.name)
    path = tmp_path / "packed.tar.gz"
    assert files.pack(tasks, runs, path) == [PENDULUM.name, REACHER.name]
    with tarfile.open(path) as archive:
        archive.extractall(here, filter="data")
    assert not list(here.rglob("metrics.csv"))
    assert results_runs.ended(here / REACHER.name)
    assert read_run(here / REACHER.name).env == REACHER.env
    files.gather(TASKS.values(), here, tmp_path / "again")
    for path in (tmp_path / "again").iterdir():
        assert path.read_bytes() == (kept / path.name).read_bytes()
    assert len(list((tmp_path / "again").iterdir())) == 6


def test_results_from_before_seeds_had_starts_of_their_own_say_so(kept, tmp_path):
    path = kept / f"{REACHER.name}.json"
    facts = json.loads(path.read_text())
    del facts["settings"]["test_episodes"]
    path.write_text(json.dumps(facts))
    results = files.load((PENDULUM, REACHER), kept)
    said = "the choice of the starts out: "
    assert f"{said}{REACHER.name}.\n" in results_page.page(results, tmp_path)


def test_the_page_without_sweeps_and_games(kept, tmp_path):
    for kind in ("sensitivity", "play"):
        (kept / f"{PENDULUM.name}-{kind}.csv").unlink()
    page = results_page.page(files.load(TASKS.values(), kept), tmp_path)
    assert "## In Gymnasium" not in page
    assert "## How much each setting matters" not in page
    assert "not played" in page


def test_a_page_of_nothing_is_refused(tmp_path):
    with pytest.raises(ValueError, match="no result yet"):
        results_page.write(files.load(TASKS.values(), tmp_path), tmp_path)


def test_unfinished_runs_are_not_gathered(tmp_path):
    run = tmp_path / "runs" / PENDULUM.name
    write_run(run, PENDULUM, [1.0, 2.0], 950.0)
    (run / "summary.json").write_text('{"status": "interrupted"}')
    files.gather([PENDULUM], tmp_path / "runs", tmp_path / "kept")
    assert files.load([PENDULUM], tmp_path / "kept") == [PENDULUM]


def test_a_film_of_the_pages_has_as_many_colours_as_its_size_allows(tmp_path):
    still = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    frames = [np.roll(still, 8 * i, axis=1) for i in range(6)]
    sizes = []
    for most in (10**6, 40_000, 20_000):
        films.write_small_gif(tmp_path / "film.gif", frames, 10.0, most)
        sizes.append((tmp_path / "film.gif").stat().st_size)
        assert sizes[-1] <= most
        with Image.open(tmp_path / "film.gif") as film:
            assert film.n_frames == 6
    assert sizes[0] > sizes[-1]
    with pytest.raises(ValueError, match="make it shorter or smaller"):
        films.write_small_gif(tmp_path / "film.gif", frames, 10.0, 100)
