"""`aftbed status`, `ps`, `graph`, `stop`: what they refuse. A live run answers in `test_live_process.py`."""

import pytest
from fakerun import Output


@pytest.mark.parametrize(
    "command", [("status",), ("ps",), ("graph",), ("stop",), ("inject", "crash", "primary")]
)
def test_no_run_is_alive(refused: Output, command: tuple[str, ...]) -> None:
    assert "no run is alive; start one with `aftbed run`" in refused(*command)
    named = refused(*command, "--run", "abcdef")
    assert "--run abcdef: no such run is alive (alive: none)" in named
    assert "no such run" in refused(*command, "--run", "../..")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--format", "svg"), ("unknown format 'svg'", "dot, mermaid, text")),
        (("--ftm", "prb"), ("unknown FTM 'prb'", "did you mean 'pbr'")),
        (("--ftm", "pbr", "--placement", "proces"), ("did you mean 'process'",)),
    ],
)
def test_options_of_graph(refused: Output, arguments: tuple[str, ...], words: tuple[str, ...]) -> None:
    error = refused("graph", *arguments)
    assert all(word in error for word in words), error
