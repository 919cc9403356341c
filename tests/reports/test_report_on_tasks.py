"""Reports on several tasks: scores of 0 untrained and 1 solved, and who is best over all."""

import numpy as np
import pytest
import vl_convert
from fake_sweeps import make_sweep
from measured_runs import make_measured_run
from pages import change_curves, visible

from mjx_reinforce import report
from mjx_reinforce.reports.findings import compute_findings
from mjx_reinforce.reports.sources import read_tasks
from mjx_reinforce.reports.tasks import compare_tasks

RATES = {"learning_rate": [1e-3, 3e-3, 1e-2]}
MORE_RATES = {"learning_rate": [1e-3, 3e-3, 1e-2, 3e-2]}


def end_at(directory, means):
    """Lets untrained seeds return 20, and those of configuration i end evenly around a mean."""

    def change(arrays):
        returns, seeds = arrays["eval_return"], arrays["seed"]
        returns[:] = 20.0
        for member, mean in enumerate(means):
            is_own = arrays["configuration"] == member
            spread = seeds[is_own] - seeds[is_own].mean()
            returns[1:, is_own] = mean + spread

    change_curves(directory, change)
    return directory


@pytest.fixture
def two_tasks(tmp_path):
    """The second has a rate more, and other seeds."""
    changes = {"env": "my.task:Other", "threshold": 520.0}
    first = make_sweep(tmp_path / "a", num_seeds=12, over=RATES, threshold=1020.0)
    second = make_sweep(tmp_path / "b", num_seeds=8, over=MORE_RATES, **changes)
    return end_at(first, [820, 920, 420]), end_at(second, [420, 320, 120, 500])


def compared(*directories):
    return compare_tasks([compute_findings(task) for task in read_tasks(directories)])


def test_scores_by_hand(two_tasks):
    found = compared(*two_tasks)
    assert found.scales == [(20, 1020), (20, 520)]
    assert [x.label for x in found.standings] == [f"learning rate {x}" for x in (1e-3, 3e-3, 0.01)]
    assert [x.mean.value for x in found.standings] == pytest.approx([0.8, 0.75, 0.3])
    # Seed by seed, both tasks differ by constants.
    behind = found.standings[1].behind
    assert [*behind] == pytest.approx([0.05] * 3, abs=1e-6)
    # Alone, the first task would take the second rate: 0.9 and 0.8.
    assert found.gain_by_tuning == pytest.approx(0.05)
    profile = found.standings[0].profile
    assert profile.value[0] == 1
    assert profile.value[-1] == 0
    assert (np.diff(profile.value) <= 0).all()


@pytest.mark.slow
def test_a_page_of_all_tasks_and_one_of_each(two_tasks, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(vl_convert, "javascript_bundle", lambda code: code)
    page = tmp_path / "all.html"
    report._report(report.ReportSettings(sources=two_tasks, output=page))
    said = visible(page)
    assert "Over 2 tasks, the best by the mean is learning rate 0.001." in said
    assert "The mean is 0.050 above that of the next, learning rate 0.003" in said
    assert "cannot be told" not in said
    assert "learning rate 0.03" not in said.partition("Table 1")[2].partition("Figure 1")[0]
    for name in ("1-InvertedPendulum-v5", "2-my.task-Other"):
        assert f'href="all/{name}.html"' in page.read_text()
        assert "my.task" not in name or "learning rate 0.03" in visible(
            page.parent / f"all/{name}.html"
        )
        assert (page.parent / f"all/{name}/results.csv").is_file()
    rows = (page.parent / "all/results.csv").read_text().splitlines()
    assert rows[0] == "task,configuration,score"
    assert len(rows) == 1 + 3 * (12 + 8)
    assert (page.parent / "all/profile.png").read_bytes().startswith(b"\x89PNG")
    # The page's own files are no sources.
    report._report(
        report.ReportSettings(sources=(*two_tasks, tmp_path / "all"), output=tmp_path / "x.html")
    )
    assert "left out, for they are reports" in capsys.readouterr().out


def test_one_run_of_each_task_is_one_configuration(tmp_path):
    runs = [make_measured_run(tmp_path / "a"), make_measured_run(tmp_path / "b", env="Other-v0")]
    (standing,) = compared(*runs).standings
    assert standing.label == "all runs"
    assert np.isnan(standing.mean.low)


def test_what_has_no_scores_in_common_is_refused(two_tasks, tmp_path):
    other = make_sweep(tmp_path / "c", env="C-v0", over={"discount": [0.9, 0.99]})
    with pytest.raises(ValueError, match="no configuration is in all tasks"):
        compared(two_tasks[0], other)
    flat = make_sweep(tmp_path / "d", env="D-v0", over=RATES, threshold=None)
    with pytest.raises(ValueError, match="D-v0 has no scores"):
        compared(two_tasks[0], end_at(flat, [20, 20, 10]))
