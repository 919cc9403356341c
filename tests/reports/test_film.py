"""The film on a run's page, from a program that only says that it made one."""

import base64
import subprocess
import types

import pytest

from mjx_reinforce.reports.page import document


@pytest.fixture
def made(monkeypatch, tmp_path):
    """Makes the film by a program that ends like this; also returns its command."""

    def make(returncode=0, stdout="", stderr="", late=False):
        commands = []

        def run(command, **options):
            commands.append(command)
            if late:
                raise subprocess.TimeoutExpired(command, options["timeout"])
            (tmp_path / "film.gif").write_bytes(b"GIF89a")
            return types.SimpleNamespace(returncode=returncode, stdout=stdout, stderr=stderr)

        monkeypatch.setattr(document.subprocess, "run", run)
        found = document.film_of_median(tmp_path / "run", tmp_path / "film.gif")
        return found, [str(x) for x in commands[0]]

    return make


def test_the_page_holds_the_film_and_its_first_line(made, tmp_path):
    found, command = made(stdout="seed 3: 950.0\nmore\n")
    assert found.said == "seed 3: 950.0"
    head, _, data = found.url.partition(",")
    assert head == "data:image/gif;base64"
    assert base64.b64decode(data) == b"GIF89a"
    assert command[1:] == [
        *("-m", "mjx_reinforce.watch", str(tmp_path / "run"), "--seed", "median"),
        *("--seconds", "8", "--width", "360", "--height", "270"),
        *("--output", str(tmp_path / "film.gif"), "--overwrite"),
    ]


@pytest.mark.parametrize(
    ("end", "said"),
    [
        ({"returncode": 1, "stderr": "warning\nerror: no model\n"}, "There is no film: no model."),
        ({"returncode": -9}, "There is no film: watch exited with -9."),
        ({"late": True}, "There is no film: it was not ready after 600 s."),
    ],
)
def test_where_there_is_none_the_page_says_why(made, end, said):
    assert made(**end)[0] == document.PageFilm(said)
