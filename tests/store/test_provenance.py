"""What a result depends on besides its settings."""

import json
import shutil
import subprocess
from pathlib import Path

import jax
import pytest
from places import ROOT

from mjx_reinforce.store import provenance as module
from mjx_reinforce.store.provenance import provenance, version, versions


def test_it_is_what_json_can_hold():
    found = provenance()
    assert json.loads(json.dumps(found)) == found
    assert found["packages"]["jax"] == jax.__version__
    assert found["num_devices"] == jax.device_count()
    assert found["x64"] is False


def test_a_package_that_is_not_installed_has_no_version():
    assert version("no-such-package-of-ours") is None
    assert version("numpy")
    assert set(versions()) == set(module._RECORDED)


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="no checkout")
def test_the_commit_is_that_of_the_checkout():
    here = subprocess.run(["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True)
    assert provenance()["git_commit"] == here.stdout.strip()


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
