"""The live view on a terminal: what it shows at any size, its keys, and that the terminal is given back."""

import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Final, cast

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from terminal import Terminal

from aftbed.cli.colour import Style
from aftbed.cli.live_view import LiveView, LogLine, Prompt, RunPicture, lines_of
from aftbed.cli.run import _follow, _open_view
from aftbed.cli.screen import Key, Screen, StyledText, fitted, keys_in
from aftbed.report import steering
from aftbed.runtime import control
from aftbed.runtime.control import Report, RequestCounts, ServiceState
from aftbed.runtime.unix.launch import Launched
from aftbed.runtime.unix.options import CarRun, RunOptions
from aftbed.runtime.unix.transport import Line, decode_report
from aftbed.vehicle.aeb.messages import AebInput, AebTarget, sight_of
from aftbed.vehicle.plant import Telemetry

OPTIONS: Final = RunOptions(
    "3f09c1", "/gone/3f09c1", "/gone/record", "pbr", "process", 7, CarRun("ccrs-50", 1.0, "latch"), port=29536
)
STATE: Final = ServiceState("pbr", False, "a", "b", 1, 211.4, RequestCounts(41, 40))
CAR: Final = Telemetry(2350, 13.9, 34.2, 2.46, 0, 0.0, 0, 10, 0)
TITLE: Final = "aftbed run 3f09c1"
WARN, FULL = 1, 3


class FakeRun:
    """The run that a view follows; it reports what the test says, and its command is on a terminal."""

    def __init__(self, columns: int = 80, rows: int = 24, **environment: str) -> None:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._line = Line(ours, decode_report)

        def command() -> int:
            ours.close()
            os.environ.pop("NO_COLOR", None)
            os.environ.update(environment)
            line = Line(theirs, decode_report)

            def reports() -> Iterator[Report]:
                while (got := line.recv()) is not None:
                    yield cast(Report, got[0])

            launched = SimpleNamespace(
                line=line, supervisor=0, reports=reports, stop=lambda: theirs.shutdown(socket.SHUT_RDWR)
            )
            interrupted = _follow(cast(Launched, launched), _open_view(OPTIONS, quiet=False), None)
            print("the verdict")
            return 130 if interrupted else 0

        self.terminal = Terminal(command, columns, rows)
        theirs.close()

    def __enter__(self) -> "FakeRun":
        return self

    def __exit__(self, *_: object) -> None:
        self._line.close()
        self.terminal.__exit__()

    def report(self, found: ServiceState | Telemetry | LogLine) -> None:
        match found:
            case LogLine():
                report = Report(control.EVENT, msgspec.json.encode(found))
            case ServiceState():
                report = Report(control.STATE, msgspec.msgpack.encode(found))
            case Telemetry():
                report = Report(control.TELEMETRY, msgspec.msgpack.encode(found))
        self._line.send(report)

    def end(self) -> None:
        self._line.close()


def changed(struct: object, **fields: object) -> object:
    return msgspec.structs.replace(struct, **fields)  # type: ignore[type-var]


def texts(lines: list[tuple[StyledText, ...]]) -> list[str]:
    return ["".join(span.text for span in line).rstrip() for line in lines]


# -- the picture ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("columns", "rows"), [(40, 10), (80, 24), (200, 60), (1, 1)])
def test_a_picture_has_the_size_of_its_screen(columns: int, rows: int) -> None:
    events = tuple(LogLine(i * 10.0, "script.done", f"failover {i}") for i in range(500))
    picture = RunPicture(TITLE, "bus: can0", 0, STATE, CAR, samples=((50.0, 34.2, 0.0),) * 300, events=events)
    lines = lines_of(picture, columns, rows)
    assert len(lines) == rows
    assert {sum(len(text) for text, _ in fitted(line, columns)) for line in lines} == {columns}
    if rows > 1:
        shown = texts([fitted(line, columns) for line in lines])
        assert "50.0 km/h" in shown[1]
        assert shown[3].startswith("pbr  a leads, b backs up, epoch 1"[:columns])
        assert "failover 499" in shown[-1]


def test_the_mechanism_is_the_one_that_runs_now() -> None:
    with FakeRun() as run:
        run.report(STATE)
        run.terminal.until_shown("pbr  a leads, b backs up, epoch 1")
        run.report(cast(ServiceState, changed(STATE, ftm="lfr+tr", leader="b", backup="a", epoch=2)))
        run.terminal.until_shown("lfr+tr  b leads, a backs up, epoch 2")
        assert "pbr" not in run.terminal.text


def test_a_replay_shows_what_the_function_sees() -> None:
    targets = (AebTarget(0, 34.0, -10.0), AebTarget(1, 60.0, -30.0))
    seen = sight_of(AebInput(1500, 20.0, True, True, targets), FULL, 6.0)
    lines = texts(lines_of(RunPicture(TITLE, state=STATE, sight=seen), 100, 24))
    words = " ".join(lines[1].split())
    assert words == "FULL 1.50 s 72.0 km/h gap 34.00 m TTC 2.0 s asks for 6.0 m/s2 2 targets"
    blind = sight_of(AebInput(1500, 0.0, False, False, ()), 0, 0.0)
    lines = texts(lines_of(RunPicture(TITLE, state=STATE, sight=blind), 100, 24))
    assert "speed unknown  radar unknown" in lines[1]


def test_a_load_shows_how_far_it_is() -> None:
    lines = texts(lines_of(RunPicture(TITLE, load=500, state=STATE), 80, 10))
    assert lines[1] == "40 of 500 requests answered"


def test_what_others_wrote_cannot_move_the_cursor() -> None:
    line = fitted((StyledText("a\x1b[2Jb\r\nc\u202e"),), 12)
    assert "".join(text for text, _ in line) == "a\ufffd[2Jb\ufffd c\ufffd  "
    wide = fitted((StyledText("日本語"),), 5)
    assert "".join(text for text, _ in wide) == "日本 "


# -- the terminal ---------------------------------------------------------------------------------


def test_it_is_redrawn_at_each_new_size() -> None:
    with FakeRun(80, 24) as run:
        run.report(STATE)
        run.report(CAR)
        for columns, rows in ((40, 10), (200, 60), (80, 24)):
            run.terminal.resize(columns, rows)
            last = "? help" if columns > 40 else "q quit"

            def drawn(rows: int = rows, last: str = last) -> bool:
                lines = run.terminal.lines
                return lines[0].startswith(f" {TITLE}") and last in lines[rows - 1]

            run.terminal.until(drawn, f"{columns}x{rows}")
            assert [TITLE in line for line in run.terminal.lines].count(True) == 1


def test_stages_and_failures_have_colours() -> None:
    with FakeRun() as run:
        for stage, name, colour in ((WARN, "WARN", "brown"), (FULL, "FULL", "red")):
            run.report(cast(Telemetry, changed(CAR, stage=stage)))
            run.terminal.until_shown(name)
            assert run.terminal.style_of(name).fg == colour
        run.report(LogLine(1.0, "lost", "no replica is left"))
        run.report(cast(Telemetry, changed(CAR, gap_m=0.0, stage=FULL)))
        run.terminal.until_shown("COLLISION")
        assert run.terminal.style_of("COLLISION").bg == "red"
        assert run.terminal.style_of("lost").fg == "red"


def test_no_color_is_obeyed() -> None:
    with FakeRun(NO_COLOR="1") as run:
        run.report(cast(Telemetry, changed(CAR, stage=FULL)))
        run.terminal.until_shown("FULL")
        assert run.terminal.style_of("FULL").fg == "default"


def test_a_dumb_terminal_gets_plain_lines() -> None:
    with FakeRun(TERM="dumb") as run:
        run.report(LogLine(1.5, "died", "a/server (pid 7)"))
        run.end()
        assert run.terminal.code() == 0
        assert b"[       1.5 ms] died: a/server (pid 7)" in run.terminal.raw
        assert b"\x1b" not in run.terminal.raw


def given_back(terminal: Terminal, before: list[object]) -> bool:
    left = terminal.raw.rpartition(b"\x1b[?1049l")
    return (
        bool(left[1])
        and b"\x1b[?25h" in left[0]
        and b"\x1b[?1049h" not in left[2]
        and terminal.modes == before
    )


@pytest.mark.parametrize(
    ("sig", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGHUP, -1), (signal.SIGQUIT, -3)]
)
def test_the_terminal_is_given_back_at_a_signal(sig: signal.Signals, code: int) -> None:
    with FakeRun() as run:
        before = run.terminal.before
        run.report(STATE)
        run.terminal.until_shown("a leads")
        assert run.terminal.modes != before
        os.kill(run.terminal.pid, sig)
        assert run.terminal.code() == code
        assert given_back(run.terminal, before)


def test_the_terminal_is_given_back_when_the_run_ends_or_the_view_fails() -> None:
    with FakeRun() as run:
        before = run.terminal.before
        run.terminal.until_shown("starting")
        run.end()
        assert run.terminal.code() == 0
        assert given_back(run.terminal, before)
        assert run.terminal.raw.rstrip().endswith(b"the verdict")
    with FakeRun() as run:
        run.terminal.until_shown("starting")
        run._line.send(Report(control.STATE, b"\xc1"))  # an error of ours
        assert run.terminal.code() == 1
        assert given_back(run.terminal, before)
        assert b"DecodeError" in run.terminal.raw


def test_a_view_is_suspended_and_continued() -> None:
    with FakeRun() as run:
        before = run.terminal.before
        run.report(STATE)
        run.terminal.until_shown("a leads")
        during = run.terminal.modes
        os.kill(run.terminal.pid, signal.SIGTSTP)  # the leader of a session is never stopped by it
        run.terminal.until(lambda: run.terminal.raw.count(b"\x1b[?1049h") == 2, "the second picture")
        assert run.terminal.raw.count(b"\x1b[?1049l") == 1
        run.terminal.until(lambda: run.terminal.modes == during, "its modes")
        run.report(cast(ServiceState, changed(STATE, epoch=2)))
        run.terminal.until_shown("epoch 2")
        run.end()
        assert run.terminal.code() == 0
        assert given_back(run.terminal, before)


def test_a_terminal_that_does_not_read_does_not_stop_the_run() -> None:
    with FakeRun() as run:
        run.report(STATE)
        run.terminal.until_shown("a leads")
        run.terminal.type("\x13")  # Ctrl-S
        run.terminal.type("p")
        for t_ms in range(0, 300_000, 50):  # each is taken: else this blocks, and the test runs out of time
            run.report(cast(Telemetry, changed(CAR, t_ms=t_ms)))
        run.terminal.type("p\x11")  # Ctrl-Q
        run.terminal.until_shown("299.95 s")


def test_a_run_ends_though_its_terminal_does_not_read() -> None:
    """What gives the terminal back comes before the verdict, when it reads again."""
    with FakeRun() as run:
        before = run.terminal.before
        run.report(STATE)
        run.terminal.until_shown("a leads")
        run.terminal.type("\x13")
        run.report(cast(ServiceState, changed(STATE, epoch=2)))
        run.end()
        run.terminal.until(lambda: run.terminal.modes == before, "the modes of before")
        run.terminal.type("\x11")
        assert run.terminal.code() == 0
        assert given_back(run.terminal, before)
        assert run.terminal.raw.rstrip().endswith(b"the verdict")


# -- keys -----------------------------------------------------------------------------------------


def test_a_frozen_picture_stands_while_the_run_goes_on() -> None:
    with FakeRun() as run:
        run.report(STATE)
        run.terminal.until_shown("epoch 1")
        run.terminal.type("p")
        run.terminal.until_shown("FROZEN")
        run.report(cast(ServiceState, changed(STATE, epoch=2)))
        run.terminal.type("?")
        run.terminal.until_shown("Escape leaves it")
        assert "epoch 1" in run.terminal.text
        run.terminal.type("p")
        run.terminal.until_shown("epoch 2")
        assert "FROZEN" not in run.terminal.text


def answering(monkeypatch: pytest.MonkeyPatch, script: str) -> None:
    """Have each command answered by this script of a shell, whose arguments are its words."""

    def child_command(words: list[str], private: Path) -> list[str]:
        return ["/bin/sh", "-c", script, private.name, *words]

    monkeypatch.setattr(steering, "child_command", child_command)


@pytest.mark.parametrize(
    ("typed", "words"),
    [
        ("icrash primary at server.exit nth 3\n", "inject|crash primary at server.exit nth 3|"),
        ("acompose lfr+tr\r", "adapt|compose|lfr+tr|"),
        ("icrash primarx\x7fy\n", "inject|crash primary|"),
        ("q", "stop|"),
    ],
)
def test_a_key_sends_the_words_of_the_command_line(
    monkeypatch: pytest.MonkeyPatch, typed: str, words: str
) -> None:
    answering(monkeypatch, 'printf "answer of %s: " $0; printf "%s|" "$@"')
    with FakeRun() as run:
        run.terminal.until_shown("? help")
        run.terminal.type(typed)
        run.terminal.until_shown(f"answer of 3f09c1: {words}")
        assert run.terminal.style_of("answer of").fg == "green"


def test_a_refusal_is_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, 'echo "aftbed: error: did you mean primary?" >&2; exit 2')
    with FakeRun() as run:
        run.terminal.until_shown("? help")
        run.terminal.type("icrash primry")
        run.terminal.until_shown("inject> crash primry")
        run.terminal.type("\n")
        run.terminal.until_shown("did you mean primary?")
        assert run.terminal.style_of("aftbed: error").fg == "red"
        run.terminal.type('a"\n')
        run.terminal.until_shown("quotation marks come in pairs")


def test_a_line_can_be_left(monkeypatch: pytest.MonkeyPatch) -> None:
    answering(monkeypatch, "echo sent")
    with FakeRun() as run:
        run.terminal.until_shown("? help")
        run.terminal.type("ic")
        run.terminal.until_shown("inject> c")
        run.terminal.type("\x1b")
        run.terminal.until_shown("? help")
        assert "sent" not in run.terminal.text


def prompt_after(typed: str, history: list[str]) -> str:
    prompt = Prompt("inject", history)
    for key in keys_in(typed):
        prompt.type(key)
    return prompt.text


@pytest.mark.parametrize(
    ("typed", "text"),
    [
        ("crsh\x1b[D\x1b[Da", "crash"),
        ("x\x01crash\x05y\x7f", "crashx"),
        ("crash primary\x17backup", "crash backup"),
        ("crash primary\x15hang", "hang"),
        ("\x1b[A\x1b[A", "first"),
        ("\x1b[A\x1b[A\x1b[A\x1b[B", "second"),
        ("\x1b[B", ""),
    ],
)
def test_a_line_is_edited_with_the_keys_of_a_shell(typed: str, text: str) -> None:
    assert prompt_after(typed, ["first", "second"]) == text


@given(st.binary(max_size=60), st.integers(1, 100))
@example("\u0610\x01".encode(), 9)  # a mark that takes no cell, under the cursor
@example("\u4f60".encode() * 10, 20)  # characters of two cells
def test_no_key_is_an_error(typed: bytes, columns: int) -> None:
    prompt = Prompt("adapt", ["to pbr"])
    for key in keys_in(typed.decode(errors="replace")):
        if key not in (Key.ENTER, Key.ESCAPE):
            prompt.type(key)
        line = fitted(prompt.line(columns), columns)
        assert Style.TITLE in [style for text, style in line if text] or columns < 9


def test_keys_are_not_read_where_standard_input_is_no_terminal() -> None:
    def command() -> int:
        reading, writing = os.pipe()
        os.write(writing, b"q")
        os.dup2(reading, 0)
        with Screen() as screen:
            screen.draw([])
            typed = screen.attend()
        print(typed, os.read(0, 10))
        return 0

    with Terminal(command) as terminal:
        before = terminal.before
        assert terminal.code() == 0
        assert b"[] b'q'" in terminal.raw
        assert terminal.modes == before


def test_y_and_n_answer_what_a_policy_asks() -> None:
    keys: list[list[Key | str]] = [["y", "n"]]
    screen = SimpleNamespace(
        has_keys=True,
        attend=keys.pop,
        can_show=lambda text: True,
        size=(80, 24),
        draw=lambda lines: True,
    )
    view, decided = LiveView(OPTIONS, cast(Screen, screen)), list[str]()
    view.decide = decided.append
    view.attend()
    assert decided == ["y", "n"]
