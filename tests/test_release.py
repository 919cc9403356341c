"""What a release is made of agrees with itself: versions, dates, requirements, workflows."""

import importlib.util
import json
import re
import subprocess
import sys
import tomllib

from places import ROOT

import mjx_reinforce

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))


def text(name):
    return (ROOT / name).read_text(encoding="utf-8")


def load_release():
    """The script that a tag is checked by."""
    spec = importlib.util.spec_from_file_location("release", ROOT / ".ci" / "release.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


RELEASE = load_release()


def test_citation_and_changelog_agree():
    version, date = RELEASE.dated(text("CITATION.cff"))
    assert RELEASE.disagreements(f"v{version}", text("CITATION.cff"), text("CHANGELOG.md")) == []
    newest = re.findall(r"^## (\d\S*) \((.*)\)$", text("CHANGELOG.md"), re.M)[0]
    assert newest == (version, date)
    assert f"year = {{{date[:4]}}}" in text("docs/index.md")
    assert PROJECT["tool"]["setuptools_scm"]["fallback_version"] == f"{version}.dev0"


def test_a_tag_that_does_not_agree_is_refused():
    version, date = RELEASE.dated(text("CITATION.cff"))
    (wrong,) = RELEASE.disagreements("v9.9.9", text("CITATION.cff"), text("CHANGELOG.md"))
    assert wrong == f"The tag is v9.9.9, but CITATION.cff has version {version}."
    (wrong,) = RELEASE.disagreements(f"v{version}", text("CITATION.cff"), "# Changelog\n")
    assert f"## {version} ({date})" in wrong
    command = [sys.executable, str(ROOT / ".ci" / "release.py")]
    for tag, status in ((f"v{version}", 0), ("v9.9.9", 1)):
        assert subprocess.run([*command, tag], capture_output=True).returncode == status


def test_the_version_is_that_of_the_installed_package():
    assert re.fullmatch(r"\d+(\.\d+)+\S*|0\+not\.installed", mjx_reinforce.__version__)


def test_constraints_are_the_versions_of_the_figures():
    pinned = dict(re.findall(r"^([\w-]+)==(\S+)$", text("constraints.txt"), re.M))
    results = sorted((ROOT / "experiments" / "studies" / "results" / "data").glob("*.json"))
    assert len(results) > 10
    older_flax = {"Ant-v5", "HalfCheetah-v5", "HumanoidStandup-v5"}  # constraints.txt says so
    for path in results:
        known = json.loads(path.read_text(encoding="utf-8"))["packages"]
        found = {name: x for name, x in known.items() if name != "mjx-reinforce"}
        assert found == pinned | ({"flax": "0.12.10"} if path.stem in older_flax else {})


def test_a_release_runs_what_main_must_pass():
    for name in ("ci", "release"):
        workflow = text(f".github/workflows/{name}.yml")
        assert "- run: .ci/run\n" in workflow
        assert "uses: ./.github/workflows/wheel.yml" in workflow
    needed = re.search(r"publish:\n    needs: \[(.*)\]", text(".github/workflows/release.yml"))[1]
    assert needed == "check, wheel"
    assert text(".github/workflows/release.yml").count("id-token: write") == 1


def test_workflows_know_the_versions_of_python():
    versions = [
        each.rpartition(" ")[2]
        for each in PROJECT["project"]["classifiers"]
        if re.search(r":: 3\.\d+$", each)
    ]
    assert f"python: {json.dumps(versions)}" in text(".github/workflows/wheel.yml")


def test_windows_is_told_where_it_trains():
    """Windows has no fcntl."""
    code = "import sys; sys.modules['fcntl'] = None; import mjx_reinforce.train"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 1
    assert "ImportError: training and reports need Linux or macOS; on Windows" in done.stderr
