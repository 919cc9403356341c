"""The report: what is on the page, that it needs nothing else, and that it loses no file."""

import csv
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import vl_convert
from browser import CHROMIUM, in_browser
from fake_sweeps import GRID, make_sweep
from measured_runs import ONE, make_measured_run
from pages import CUT, change_curves, content, findings_of, run_report, visible

from mjx_reinforce import report
from mjx_reinforce.reports import charts, document, findings, sources, words
from mjx_reinforce.reports.findings import worst_seeds

HOSTILE = "x</script><script>alert(1)</script>\"'&"


@pytest.fixture
def no_pictures(monkeypatch):
    """Leaves out the files beside the page that take the most time."""
    monkeypatch.setattr(report, "render_chart", lambda *_: {})


@pytest.fixture
def text_alone(no_pictures, monkeypatch):
    """Leaves out Vega too, which takes seconds to pack into the page."""
    monkeypatch.setattr(vl_convert, "javascript_bundle", lambda code: code)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A sweep and its page; test_report_learning.py looks at the pictures."""
    directory = make_sweep(tmp_path_factory.mktemp("sweeps") / "sweep", num_seeds=40)
    page = directory / "report.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "render_chart", lambda *_: {})
        report.write_report([directory], page)
    return directory, page


@pytest.fixture(scope="module")
def found(written):
    return findings.compute_findings(sources.read_experiment([written[0]]))


def test_the_page_needs_nothing_else(written):
    text = written[1].read_text(encoding="utf-8")
    markup = re.sub(r"<script\b.*?</script>", "", text, flags=re.S)
    assert not re.search(r'(src|href)="(?!#|data:)', markup)
    assert "url(" not in markup
    assert "@import" not in markup
    assert not re.search(r"<script[^>]+src", text)


def test_the_page_says_what_was_found(written, found):
    said = visible(written[1])
    best = found.results[0]
    for sentence in (*words.headline(found), *words.caveats(found)):
        assert " ".join(sentence.split()) in said
    assert f"{best.solving.at_end} of its 40 seeds solve the task at the end" in said
    for each in found.results:
        assert each.configuration.label in said
    for fact in (
        "0123456789abcdef",
        "mujoco 4.0.0",
        "compile time",
        "21.4 s",
        "--over learning-rate",
    ):
        assert fact in said


def test_the_figures_are_those_of_the_curves(found):
    """The best by a mean that is worked out here, and its numbers."""
    parts = found.experiment.configurations
    finals = np.array([part.eval_return[-1] for part in parts])
    scores = np.where(np.isfinite(finals), finals, np.nanmin(finals))
    assert found.results[0].configuration.label == parts[scores.mean(axis=1).argmax()].label
    assert [parts[i].label for i in found.order] == [r.configuration.label for r in found.results]
    for result in found.results:
        returns = result.configuration.eval_return
        assert result.solving.ever == (np.nan_to_num(returns) >= 950).any(axis=0).sum()
        assert result.solving.at_end == (returns[-1] >= 950).sum()
        assert result.mean.low <= result.mean.value <= result.mean.high
    assert len(found.comparisons) == 16 * 15 / 2


def tables_of(found):
    """The data of all charts."""
    return {
        name: table for each in document.draw_charts(found) for name, table in each.data.items()
    }


def test_a_histogram_has_every_seed(found):
    data = tables_of(found)["histogram"]
    last = len(charts.slider_stops(found)) - 1
    for place, result in enumerate(found.results):
        rows = zip(data["configuration"], data["moment"], data["share"], strict=True)
        share = sum(share for c, m, share in rows if (c, m) == (place, last))
        finite = np.isfinite(result.seeds[-1]).mean()
        assert share == pytest.approx(finite, abs=0.005)


def test_solved_share_rises_to_those_who_ever_did(found):
    data = tables_of(found)["solved"]
    for place, result in enumerate(found.results):
        shares = [
            s for c, s in zip(data["configuration"], data["share"], strict=True) if c == place
        ]
        assert shares == sorted(shares)
        assert shares[-1] == pytest.approx(result.solving.ever / 40, abs=1e-4)


def solve_at_the_end(directory, runs, threshold):
    """Lets some runs of a sweep reach the threshold at their last evaluation, not before."""

    def change(arrays):
        before, last = arrays["eval_return"][:-1], arrays["eval_return"][-1]
        before[:, runs] = np.minimum(before[:, runs], threshold / 2)
        last[runs] = threshold + 10

    change_curves(directory, change)


@pytest.mark.usefixtures("text_alone")
@pytest.mark.slow
def test_tables_and_figures_agree_on_who_solved(tmp_path):
    """Seeds end at different env steps; the figures' last place is the end of each, as table 1."""
    directory = make_sweep(tmp_path / "sweep", num_seeds=40, over=ONE)
    solve_at_the_end(directory, [1, 5, 9, 42, 77], 950)
    report.write_report([directory], directory / "report.html")
    shown = findings_of(directory)
    data, said = tables_of(shown), visible(directory / "report.html")
    for place, result in enumerate(shown.results):
        at_end = int((result.configuration.eval_return[-1] >= 950).sum())
        ever = int((result.configuration.eval_return >= 950).any(axis=0).sum())
        assert f"{at_end} of 40 " in said  # table 1
        rows = zip(data["moments"]["configuration"], data["moments"]["said"], strict=True)
        assert f", {at_end} of 40 solved" in [text for c, text in rows if c == place][-1]
        rows = zip(data["solved"]["configuration"], data["solved"]["share"], strict=True)
        assert [share for c, share in rows if c == place][-1] == pytest.approx(ever / 40, abs=1e-4)
    assert "the last evaluation of each seed, as in table 1" in (
        directory / "report.html"
    ).read_text(encoding="utf-8")


def test_numbers_lie_beside(written):
    directory, page = written
    beside = directory / "report"
    lines = (beside / "results.csv").read_text().splitlines()
    assert lines[0].startswith("configuration,learning_rate,discount,seed,final_return")
    assert len(lines) == 1 + 16 * 40
    assert content(page)["results"].splitlines() == lines


def cells(path):
    """All cells of a CSV file but the header's."""
    with path.open(encoding="utf-8", newline="") as file:
        return [cell for row in list(csv.reader(file))[1:] for cell in row]


def test_every_table_names_its_configurations(written):
    files = sorted((written[0] / "report").glob("*.csv"))
    assert {path.name for path in files} >= {"final.csv", "curves.csv"}
    assert [p.name for p in files if "configuration" not in p.read_text().splitlines()[0]] == []


@pytest.mark.usefixtures("text_alone")
def test_a_run_alone_and_names_that_are_markup(tmp_path):
    directory = make_measured_run(tmp_path / "<b>run", env=HOSTILE, note=HOSTILE)
    page = tmp_path / "page.html"
    report.write_report([directory], page)
    text = page.read_text(encoding="utf-8")
    assert "alert(1)</script>" not in text
    assert text.count("<script") == 3
    assert "<b>run" not in text
    assert HOSTILE in visible(page)
    assert "Pair by pair" not in visible(page)
    assert f"watch '{directory}' --seed 0" in visible(page)


def test_the_worst_seed_is_watched_by_the_policy_that_its_sweep_kept(tmp_path):
    directory = make_sweep(tmp_path / "a sweep", num_seeds=12)
    experiment = sources.read_experiment([directory])
    figures = findings.compute_findings(experiment)
    number, best = figures.order[0], figures.results[0]
    seed = int(best.configuration.seed[worst_seeds(best)[0]])
    place = directory / "policies" / f"{number:03d}"
    (place / "policy").mkdir(parents=True)
    known = {"env": "InvertedPendulum-v5", "horizon": 1000, "seeds": [seed, 99]}
    (place / "config.json").write_text(json.dumps(known))
    watch = report.how_to_watch(experiment, figures)
    assert watch == f"python -m mjx_reinforce.watch '{place}' --seed {seed}"
    (place / "config.json").write_text(json.dumps(known | {"seeds": [98, 99]}))
    assert report.how_to_watch(experiment, figures) == ""


@pytest.mark.usefixtures("text_alone")
def test_seeds_that_all_failed_are_no_answer(tmp_path):
    directory = make_sweep(tmp_path / "sweep", num_seeds=5, over=ONE)
    change_curves(directory, lambda arrays: arrays["eval_return"][2:].fill(np.nan))
    report.write_report([directory], directory / "report.html")
    assert "There is no answer" in visible(directory / "report.html")


@pytest.mark.slow
def test_command_line(tmp_path):
    """It writes into the run."""
    run = make_measured_run(tmp_path / "run")
    page = run / "report.html"
    done = run_report(run)
    assert done.returncode == 0, done.stderr
    assert str(page) in done.stdout
    assert (run / "report" / "results.csv").is_file()
    assert "<!doctype html>" in page.read_text()
    assert (run / "report" / "curves.png").is_file()


def said_by_main(monkeypatch, capsys, *arguments):
    """What the command says, or how it refuses; nothing is drawn."""
    monkeypatch.setattr(report.document, "draw_charts", lambda findings: [])
    monkeypatch.setattr(report.document, "render", lambda *arguments: "a page")
    monkeypatch.setattr(sys, "argv", ["report", *map(str, arguments)])
    status = 0
    try:
        report.main()
    except SystemExit as stop:
        status = stop.code
    return status, "".join(capsys.readouterr())


def test_pages_go_where_they_belong(tmp_path, monkeypatch, capsys):
    """Of A into A, of B into B, of both here: none replaces another, nor the pictures alone."""
    monkeypatch.chdir(tmp_path)
    first, second = make_measured_run(tmp_path / "a"), make_measured_run(tmp_path / "b")
    for chosen, page in (
        ([first], first / "report.html"),
        ([second], second / "report.html"),
        ([first, second], tmp_path / "report.html"),
    ):
        assert said_by_main(monkeypatch, capsys, *chosen)[0] == 0
        assert page.read_text() == "a page"
        status, said = said_by_main(monkeypatch, capsys, *chosen)
        assert status == 2
        assert said.endswith("report.html exists; pass --overwrite or another --output\n")
        page.unlink()
        status, said = said_by_main(monkeypatch, capsys, *chosen)
        assert (status, "report exists; pass --overwrite" in said) == (2, True)
        assert said_by_main(monkeypatch, capsys, *chosen, "--overwrite")[0] == 0
    status, said = said_by_main(monkeypatch, capsys, tmp_path / "none")
    assert (status, said) == (
        2,
        f"error: there is no directory {tmp_path / 'none'}; name that of a run or a sweep\n",
    )


def test_a_report_never_writes_among_runs(tmp_path, monkeypatch, capsys):
    """As in clusters.md: the folder of shares has the name of the page; and again, over it."""
    monkeypatch.chdir(tmp_path)
    for k in range(2):
        make_measured_run(Path(f"hopper/{k}"), first=3 * k, seeds=f"{3 * k}:{3 * k + 3}")
    before = sorted(Path("hopper").rglob("*"))
    for more in ((), ("--overwrite",)):
        command = ("hopper/0", "hopper/1", "--output", "hopper.html", *more)
        status, said = said_by_main(monkeypatch, capsys, *command)
        assert (status, "pictures and tables in hopper-report\n" in said) == (0, True)
        assert Path("hopper-report/results.csv").is_file()
        assert sorted(Path("hopper").rglob("*")) == before
    assert said_by_main(monkeypatch, capsys, "hopper/0", "--output", "hopper/0.html")[0] == 0
    assert sorted(path.name for path in Path("hopper/0").iterdir()) == [
        *("config.json", "metrics.csv", "summary.json")
    ]


def test_what_a_report_wrote_does_not_stop_the_next(tmp_path, monkeypatch, capsys):
    """Where the runs are, whose page names all that is there."""
    for k in range(2):
        make_measured_run(tmp_path / f"{k}", first=3 * k, seeds=f"{3 * k}:{3 * k + 3}")
    monkeypatch.chdir(tmp_path)
    assert said_by_main(monkeypatch, capsys, "0", "1")[0] == 0
    there = sorted(path.name for path in tmp_path.iterdir())
    assert there == ["0", "1", "report", "report.html"]
    status, said = said_by_main(monkeypatch, capsys, *there, "--overwrite")
    assert status == 0
    assert said.startswith("left out, for they are reports: report, report.html\n")
    status, said = said_by_main(monkeypatch, capsys, "report.html")
    assert (status, "there is no directory report.html" in said) == (2, True)


def test_a_directory_that_is_lost_meanwhile_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make_measured_run(tmp_path / "a")
    how = report.how_to_watch
    monkeypatch.setattr(report, "how_to_watch", lambda *x: (Path("a").rename("b"), how(*x))[1])
    status, said = said_by_main(monkeypatch, capsys, "a")
    assert (status, Path("a").exists()) == (1, False)
    assert said == "error: cannot write a/report.html: a was moved or removed\n"


def test_a_source_that_is_named_twice_is_refused(tmp_path, monkeypatch, capsys):
    make_measured_run(tmp_path / "a", seeds="0:3")
    monkeypatch.chdir(tmp_path)
    for other in ("a", "./a", tmp_path / "a", "a/../a"):
        status, said = said_by_main(monkeypatch, capsys, "a", other)
        assert status == 2
        assert said == f"error: a and {Path(other)} are one directory: name each source once\n"


@pytest.mark.parametrize("name", ["page.txt", "none/page.html", "folder.html", "page.html"])
def test_outputs_that_cannot_be_are_refused(tmp_path, name):
    (tmp_path / "folder.html").mkdir()
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match=name.partition("/")[0].partition(".")[0]):
        report.check_page(tmp_path / name, overwrite=False)


@pytest.mark.parametrize(("seeds", "none"), [(8, ": all seeds are alike"), (3, " below six seeds")])
def test_ties_are_said_as_ties(tmp_path, seeds, none):
    """Equal means are not "0.0 above", and p = 1 is not "or more"; no interval has no width."""
    directory = make_sweep(tmp_path / "sweep", num_seeds=seeds, over=ONE)
    change_curves(directory, lambda arrays: arrays["eval_return"][-1].fill(1000.0))
    said = " ".join(words.headline(findings_of(directory)))
    assert "The mean equals that of the next" in said
    assert f"1,000.0 (no interval{none})." in said
    assert ("3 seeds are too few to tell" in said) == (seeds == 3)
    assert "(p = 1)." in said


def test_a_configuration_that_ended_earlier_stays_at_its_end(tmp_path):
    """At the slider's last stop its histogram is of its final returns, and says so."""
    directory = make_sweep(tmp_path / "sweep", num_seeds=40, over=ONE)

    def change(arrays):
        arrays["env_steps"][:, arrays["configuration"] == 0] //= 2

    arrays = change_curves(directory, change)
    shown = findings_of(directory)
    place = shown.order.index(0)
    drawn = tables_of(shown)
    last = len(charts.slider_stops(shown)) - 1
    said = drawn["moments"]["said"][place * (last + 1) : (place + 1) * (last + 1)]
    assert "its end: " in said[last]
    assert "its end: " not in said[0]
    bars = drawn["histogram"]
    rows = zip(bars["configuration"], bars["moment"], bars["share"], strict=True)
    final = arrays["eval_return"][-1, arrays["configuration"] == 0]
    share = sum(share for c, m, share in rows if (c, m) == (place, last))
    assert share == pytest.approx(np.isfinite(final).mean(), abs=0.005)


def _script(name):
    return (Path(__file__).parent / f"{name}.js").read_text("utf-8")


#: Charts whose legend, words or axes lie outside their picture, where print cuts them.
OVERFLOW = """[...document.querySelectorAll('.chart')].filter((chart) => {
  const box = (name) => chart.querySelector(name).getBoundingClientRect();
  const [whole, drawn] = [box('svg'), box('svg g')];
  return drawn.top < whole.top - 1 || drawn.bottom > whole.bottom + 1;
}).map((chart) => chart.id)"""


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
def test_charts_are_whole_at_any_width_and_on_paper(tmp_path):
    directory = make_sweep(
        tmp_path / "sweep", num_seeds=8, over={"learning_rate": [1e-3, 3e-3, 1e-2]}
    )
    page = directory / "report.html"
    report.write_report([directory], page)
    assert in_browser(page, _script("printed").replace("OVERFLOW", OVERFLOW)) == [[]] * 6


#: Cells of table 1 whose words are not seen.
HIDDEN = """[...document.querySelectorAll('.results td, .results tbody th')].filter((cell) => {
  const box = cell.getBoundingClientRect();
  return !box.width || box.left < 0 || box.right > innerWidth;
}).map((cell) => cell.textContent)"""
WIDTHS = [360, 390, 480, 640, 768, 831, 832, 833, 900, 1024, 1280, 1920]


@pytest.mark.usefixtures("no_pictures")
@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
@pytest.mark.parametrize("over", [ONE, GRID], ids=["two", "sixteen"])
def test_no_column_is_cut_at_any_width(tmp_path, over):
    """From a phone to a wide screen, also where returns have seven digits."""
    directory = make_sweep(tmp_path / "sweep", num_seeds=8, over=over)
    change_curves(directory, lambda x: x.update(eval_return=-1234.5678 * x["eval_return"]))
    page = directory / "report.html"
    report.write_report([directory], page)
    script = f"""const found = [];
      document.querySelectorAll('details.data').forEach((x) => {{ x.open = true }});
      await until(() => [...document.querySelectorAll('.numbers')].every((x) => x.innerText));
      for (const width of {WIDTHS}) {{
        await resize(width);
        const wide = document.documentElement.scrollWidth > width;
        found.push([{CUT}, {HIDDEN}, wide]);
      }}
      return found"""
    found = in_browser(page, script, width=360)
    assert dict(zip(WIDTHS, found, strict=True)) == {width: [[], [], False] for width in WIDTHS}


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here")
def test_in_a_browser(written):
    """The slider moves the histograms, a curve says what it is, and choices show what is chosen."""
    charts, shown, told, width = in_browser(written[1], _script("used"))
    assert (charts, shown, width) == (6, 4, 390)
    assert any(label in told for label in content(written[1])["labels"])
