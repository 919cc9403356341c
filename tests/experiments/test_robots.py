"""Robots of others are judged beside C MuJoCo, each by a process of its own."""

import itertools

import pytest

from experiments.checks.robots import __main__ as robots
from experiments.checks.robots import gpu, models, page, playing, teams
from experiments.kit import device_code, rows
from experiments.speed.benchmark import rows as benchmark_rows
from experiments.speed.benchmark.robots import make
from mjx_reinforce.engine.play import cxx

#: A slide that a motor pushes against a wall; {} are options.
MODEL = """
<mujoco>
  <option {option}/>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body pos="0 0 .1">
      <joint name="slide" type="slide" axis="0 0 1"/>
      <geom size=".1"/>
    </body>
  </worldbody>
  {actuator}
  <sensor><jointvel joint="slide"/></sensor>
</mujoco>
"""
MOTOR = '<actuator><motor joint="slide" ctrlrange="-9 9"/></actuator>'


def write_models(folder):
    """Writes two robots, one of them twice, one that has no motor, and a part of a model."""
    folder.mkdir(parents=True)
    elliptic = MODEL.format(option='cone="elliptic"', actuator=MOTOR)
    (folder / "elliptic.xml").write_text(elliptic)
    (folder / "elliptic_again.xml").write_text(elliptic)
    (folder / "pyramidal.xml").write_text(MODEL.format(option="", actuator=MOTOR))
    (folder / "still.xml").write_text(MODEL.format(option="", actuator=""))
    (folder / "part.xml").write_text('<mujoco><include file="nowhere.xml"/></mujoco>')
    (folder / "other.xml").write_text("<robots/>")


@pytest.mark.slow
def test_each_model_has_a_row_and_is_judged_once(tmp_path):
    write_models(tmp_path / "package" / "assets")
    path = tmp_path / "rows.csv"
    for phase in ("equality", "speed", "equality"):
        robots.main(robots.Settings(phase, path, tmp_path))
    raw_rows = rows.read(path)
    assert len(raw_rows) == 5 + 2
    by_name = {row["model"].removeprefix("assets/"): row for row in page.merged(raw_rows)}
    assert {name: row["verdict"] for name, row in by_name.items()} == {
        "elliptic.xml": "equal",
        "elliptic_again.xml": "same mechanism",
        "pyramidal.xml": "equal",
        "still.xml": "no actuators",
        "part.xml": "no model",
    }
    slow, fast = by_name["elliptic.xml"], by_name["pyramidal.xml"]
    expected_engine = "mujoco" if cxx.compiler() is None else "native"
    assert (slow["engine"], slow["why"]) == (expected_engine, "elliptic cones")
    assert fast["engine"] == "native"
    for row in (slow, fast):
        assert float(row["error"]) <= playing.EQUAL
        assert float(row["ratio"]) > 0
    timed = [row for row in raw_rows if row["phase"] == "speed"]
    assert all(float(row["ratio_by_clock"]) > 0 for row in timed)


@pytest.mark.slow
@pytest.mark.skipif(device_code.COMPILER is None, reason="there is no C++ compiler")
def test_teams_are_compared_with_c_mujoco_and_counted(tmp_path, capsys):
    folder = tmp_path / "mujoco_menagerie" / "slider"
    folder.mkdir(parents=True)
    (folder / "scene.xml").write_text(MODEL.format(option="", actuator=MOTOR))
    (folder / "slider_mjx.xml").write_text(MODEL.format(option='solver="CG"', actuator=MOTOR))
    (folder / "part.xml").write_text('<mujoco><include file="nowhere.xml"/></mujoco>')
    path = tmp_path / "rows.csv"
    for _ in range(2):
        robots.main(robots.Settings("teams", path, tmp_path))
    part, scene, for_mjx = rows.read(path)
    assert part["verdict"] == "no model"
    assert for_mjx["verdict"] == "refused"
    assert "Newton" in for_mjx["cause"]
    assert scene["verdict"] == "accepted"
    assert float(scene["error20"]) < teams.MAX_ERROR
    assert float(scene["ratio200"]) < teams.MAX_RATIO
    table = capsys.readouterr().out.splitlines()
    assert "| Menagerie's files for MJX | 1 | 0 | 0 | 0 | 0 | 0 |" in table
    assert table[-1] == "| all | 2 | 1 | 1 | 1 | 1 | 1 |"


def test_only_meshes_that_are_not_there_are_tetrahedra(tmp_path):
    corners = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    text = "".join(f"v {x} {y} {z}\n" for x, y, z in corners) + "f 1 2 3\n"
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "cube.obj").write_text(text)
    meshes = "".join(
        f'<mesh file="{x}.obj" inertia="convex"/>' for x in ("cube", "parts/cube", "gone")
    )
    geoms = "".join(f'<geom type="mesh" mesh="{x}"/>' for x in ("near", "cube", "gone"))
    meshes = meshes.replace('"parts/cube.obj"', '"parts/cube.obj" name="near"')
    body = f"<body><freejoint/>{geoms}</body>"
    (tmp_path / "robot.xml").write_text(
        f"<mujoco><asset>{meshes}</asset><worldbody>{body}</worldbody></mujoco>"
    )
    model, stubs = models.load(tmp_path / "robot.xml")
    assert stubs == "2 meshes are tetrahedra"
    assert [model.mesh(x).vertnum[0] for x in ("near", "cube", "gone")] == [8, 4, 4]


def test_speeds_of_a_gpu_are_beside_what_teams_cover(tmp_path, monkeypatch):
    model = MODEL.format(option="", actuator=MOTOR)
    folder = tmp_path / "mujoco_menagerie"
    team_rows = []
    for name in ("slow", "fast", "refused"):
        (folder / name).mkdir(parents=True)
        (folder / name / "scene.xml").write_text(model)
        row = dict.fromkeys(teams.COLUMNS, "") | {"nu": "1", "nv": "1"}
        row |= {"package": "mujoco_menagerie", "model": f"{name}/scene.xml"}
        row |= {"verdict": "accepted", "error20": "1e-12"}
        if name == "refused":
            row |= {"verdict": "refused", "cause": "the model has a plugin", "error20": ""}
        team_rows.append(row)
    rows.write(tmp_path / "teams.csv", team_rows)
    called = []

    def conduct(settings):
        called.append(settings.tasks)
        speeds = {"native": 6e5, "MuJoCo Warp": 1e5}
        timed = [
            {"task": task, "engine": engine, "batch": batch, "steps": 50}
            | {"env_steps_per_second": [speed, speed]}
            for task in settings.tasks[:1]  # the other one fails
            for engine, speed in speeds.items()
            for batch in settings.batches
        ]
        benchmark_rows.append(settings.csv, timed)

    monkeypatch.setattr(gpu.benchmark, "conduct", conduct)
    timed = tmp_path / "gpu.csv"
    for seconds in (200.0, 600.0, 600.0):  # what failed is tried again, and then left out
        gpu.measure(timed, tmp_path, tmp_path / "teams.csv", seconds, "")
    names = [[task.rpartition("/mujoco_menagerie/")[2] for task in tasks] for tasks in called]
    assert names == [["slow/scene.xml", "fast/scene.xml"], ["fast/scene.xml"]]
    gpu.write(tmp_path / "page.csv", tmp_path / "teams.csv", timed, tmp_path)
    table = gpu.robots(rows.read(tmp_path / "page.csv")).splitlines()
    assert "| slow/scene.xml | 1 | 1e-12 |  |" in table
    assert "| refused/scene.xml | 1 | a plugin |  |" in table
    speeds = gpu.speeds(rows.read(tmp_path / "page.csv")).splitlines()
    assert "| slow/scene.xml | 600,000 | 100,000 | 600,000 | 100,000 | 6.0 | 6.0 |" in speeds
    assert "refused" not in "".join(speeds)
    summary = gpu.summary(rows.read(tmp_path / "page.csv"))
    assert "| Menagerie's robots | 3 | 2 | 6.0 of 2 |" in summary
    gpu.write(tmp_path / "page.csv", tmp_path / "teams.csv", tmp_path / "nothing.csv", tmp_path)
    untimed = rows.read(tmp_path / "page.csv")
    assert "| slow/scene.xml | 1 | 1e-12 |  |" in gpu.robots(untimed).splitlines()
    assert "| Menagerie's robots | 3 | 2 | not timed |" in gpu.summary(untimed)


@pytest.mark.slow
def test_a_robot_of_the_gpus_rows_plays(tmp_path):
    (tmp_path / "model.xml").write_text(MODEL.format(option="", actuator=MOTOR))
    env = make(gpu.task_of(tmp_path / "model.xml"))
    state = env.step(env.reset(playing.jax.random.key(0)), playing.np.ones(1))
    assert state.obs.shape == (2,)
    assert playing.np.isfinite(state.reward)


@pytest.mark.parametrize(
    ("name", "place"), itertools.product(("observation", "reward"), ((-1,), (0,)))
)
def test_a_difference_is_seen_wherever_it_is(name, place):
    expected = playing.Played(*map(playing.np.ones, ((4, 3), 3, 3)))
    array = getattr(expected, name).copy()
    array[place] += 1e-6
    error, words = playing.difference(expected._replace(**{name: array}), expected)
    assert error == pytest.approx(1e-6)
    assert words.startswith(name)


def test_robots_timed_with_a_c_compiler_are_in_a_table():
    made = {"why": "machine code for this CPU, made by the C++ compiler", "engine": "native"}
    made |= {"model": "a/scene.xml", "stubs": "", "verdict": "measured", "cause": ""}
    made |= {"steps_per_s": "12345", "ratio": "3.2", "ratio_by_clock": "3.1"}
    late = dict.fromkeys(made, "") | {"model": "late", "verdict": "too long", "cause": "over 9 s"}
    slow = made | {"why": "it has a plugin", "engine": "mujoco", "ratio": "0.9", "stubs": "stubs"}
    assert page.cpu_robots([late, made, slow]).splitlines()[2:] == [
        "| a/scene.xml (stubs) | C MuJoCo's own | 12,345 | 0.9 | 3.1 |",
        "| a/scene.xml | C++ | 12,345 | 3.2 | 3.1 |",
        "| late |  | too long: over 9 s |  |  |",
    ]


def test_the_page_is_that_of_the_rows():
    text = page.PAGE.read_text(encoding="utf-8")
    assert page.page(text, rows.read(page.CSV)) == text
    assert "### " in text
