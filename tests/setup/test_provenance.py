"""What a result depends on besides its settings."""

import json
import shutil
import subprocess
from pathlib import Path

import jax
import pytest
from places import ROOT

from mjx_reinforce.setup import provenance as module
from mjx_reinforce.setup.provenance import provenance, version


def test_it_is_what_json_can_hold():
    found = provenance()
    assert json.loads(json.dumps(found)) == found
    assert found["packages"]["jax"] == jax.__version__
    assert found["num_devices"] == jax.device_count()
    assert found["x64"] is False


def test_a_package_that_is_not_installed_has_no_version():
    assert version("no-such-package-of-ours") is None
    assert version("numpy")


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no checkout")
def test_the_commit_is_one_of_the_checkout():
    known = ["git", "-C", ROOT, "cat-file", "-t", provenance()["git_commit"]]
    assert subprocess.run(known, capture_output=True, text=True).stdout == "commit\n"


def test_the_commit_is_the_last_that_changed_the_package(tmp_path, monkeypatch):
    package, tasks = tmp_path / "mjx_reinforce", tmp_path / "envs"
    (package / "setup").mkdir(parents=True)
    tasks.mkdir()
    (package / "envs").symlink_to("../envs")
    copy = shutil.copy(module.__file__, package / "setup" / "provenance.py")
    monkeypatch.setattr(module, "__file__", str(copy))
    git = ["git", "-C", tmp_path, "-c", "user.name=A", "-c", "user.email=a@example.org"]
    subprocess.run([*git, "init", "-q"], check=True)

    def commit_after_writing(path):
        path.write_text("new")
        subprocess.run([*git, "add", "-A"], check=True)
        subprocess.run([*git, "commit", "-q", "-m", path.name], check=True)
        return module._git_commit()

    first = commit_after_writing(package / "train.py")
    assert commit_after_writing(tmp_path / "README.md") == first
    second = commit_after_writing(tasks / "ant.py")
    assert second not in (None, first)


def test_a_file_that_git_does_not_track_is_of_no_commit(tmp_path, monkeypatch):
    copy = shutil.copy(module.__file__, tmp_path / "provenance.py")
    monkeypatch.setattr(module, "__file__", str(copy))
    assert module._git_commit() is None
    git = ["git", "-C", tmp_path, "-c", "user.name=A", "-c", "user.email=a@example.org"]
    subprocess.run([*git, "init", "-q"], check=True)
    subprocess.run([*git, "commit", "-q", "--allow-empty", "-m", "another's"], check=True)
    assert module._git_commit() is None


def test_without_git_there_is_no_commit(monkeypatch):
    monkeypatch.setenv("PATH", str(Path(__file__).parent))
    assert module._git_commit() is None
