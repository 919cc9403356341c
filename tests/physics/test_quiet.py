"""The module of MJX that prints where Warp is missing, and no other, is imported in silence."""

import builtins
import importlib
import sys

import pytest

from mjx_reinforce.physics import quiet

SOURCE = "print('no warp'); import sys; NUMBER = 3; sys.stdout.write('heard ')\n"


@pytest.fixture
def package(monkeypatch, tmp_path):
    """A package with two modules that print, of which one is MJX's."""
    folder = tmp_path / "printing"
    folder.mkdir()
    for name in ("__init__", "warp", "other"):
        (folder / f"{name}.py").write_text("" if name == "__init__" else SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    monkeypatch.setattr(quiet, "_WARP", "printing.warp")
    quiet.silence_mjx()
    yield "printing"
    for name in [name for name in sys.modules if name.startswith("printing")]:
        del sys.modules[name]


def test_only_that_module_prints_nothing(package, capsys):
    module = importlib.import_module(f"{package}.warp")
    assert capsys.readouterr().out == "heard "
    assert module.NUMBER == 3
    assert "print" not in vars(module)
    importlib.import_module(f"{package}.other")
    assert capsys.readouterr().out == "no warp\nheard "
    assert print is builtins.print


def test_a_module_that_is_not_there_is_missing(package, monkeypatch):
    monkeypatch.setattr(quiet, "_WARP", f"{package}.gone")
    with pytest.raises(ModuleNotFoundError, match="gone"):
        importlib.import_module(f"{package}.gone")
