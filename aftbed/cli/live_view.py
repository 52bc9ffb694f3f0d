"""The view of a live run on a terminal: the road, the roles, counts, events; and keys.

| key      | does                                                                             |
|----------|----------------------------------------------------------------------------------|
| `p`      | freezes the picture, and lets it go on; the run goes on meanwhile                 |
| `i`, `a` | a line for the words of `aftbed inject`, of `aftbed adapt`; the answer is shown  |
| `y`, `n` | the answer to what `--approve ask` asks                                          |
| `q`      | `aftbed stop`                                                                    |
| `?`      | explains the keys                                                                |

**Why `p` does not pause the run.** Its clocks are real: while the car stood still, the radar would be silent,
and the E2E timeouts of gateway and brakes would notice that as a fault that was not injected. Each deadline
of the judge would count the time of the pause, too.

What is shown is a `RunPicture`; `lines_of` lays it out for any size, and draws nothing by itself. A command
is a process of its own at a low priority (`report.steering`), so neither the run nor the view waits for it.
"""

import os
import shlex
import textwrap
import time
from collections import deque
from collections.abc import Iterator, Sequence
from itertools import islice
from math import ceil
from pathlib import Path
from typing import Final

import msgspec

from aftbed.cli.colour import Style
from aftbed.cli.screen import IDLE_S, PERIOD_S, Key, Line, Screen, StyledText, cells
from aftbed.cli.views import KMH_PER_MS, STAGES, RunView, bus_line, requests_line
from aftbed.core.errors import shown
from aftbed.report.steering import ANSWER_CHARACTERS_MAX, COMMAND_S_MAX, start_command
from aftbed.runtime.control import ServiceState
from aftbed.runtime.unix import linux
from aftbed.runtime.unix.options import LoadRun, RunOptions
from aftbed.vehicle.aeb.messages import STAGE_NONE, Sight
from aftbed.vehicle.plant import Telemetry

EVENTS_KEPT: Final = 500
SAMPLES_KEPT: Final = 1000
SAMPLE_MS: Final = 100  # of bus time, in a column of the plots
ROAD_M: Final = 60.0  # at least, from the car to the end of the road
LINES_OF_ANSWER_MAX: Final = 4
# A screen with fewer rows has no place for these.
ROWS_FOR_COUNTS, ROWS_FOR_PLOTS = 12, 20
BARS: Final = " ▁▂▃▄▅▆▇█"  # from 0 on
STYLES_OF_STAGES: Final = (Style.PLAIN, Style.WARN, Style.WARN, Style.SERIOUS)
STYLES_OF_EVENTS: Final = {
    **dict.fromkeys(("died", "alarm", "hangs", "refused", "stalled", "question"), Style.WARN),
    **dict.fromkeys(("lost", "trouble", "launch.failed", "script.failed"), Style.SERIOUS),
    **dict.fromkeys(("fault", "armed", "met"), Style.ODD),
    **dict.fromkeys(("adapt", "adapted", "proposed", "proposal"), Style.NOTE),
    **dict.fromkeys(("script.done", "replaced"), Style.GOOD),
}
KEY_LINE: Final = "p freeze i inject a adapt q quit ? help"
HELP: Final = (
    "p  freeze the picture, and let it go on; the run goes on",
    "i  inject a fault: crash primary at server.exit nth 3",
    "a  adapt: compose lfr+tr, switch lfr, to pbr, decompose",
    "y  n  answer the question of a policy",
    "q  end the run, as aftbed stop; Ctrl-C, as SIGINT",
    "Enter sends a line, Escape leaves it, Up has the last ones",
)


# -- what is shown --------------------------------------------------------------------------------


class LogLine(msgspec.Struct, frozen=True):
    """A line of the run's log, or of the policy's."""

    t_ms: float
    event: str
    text: str


class RunPicture(msgspec.Struct):
    """A run as it is now. Of a drive there is `telemetry`, of a replay `sight`."""

    title: str
    bus: str = ""
    load: int = 0  # requests of a load, which has neither
    state: ServiceState | None = None
    telemetry: Telemetry | None = None
    sight: Sight | None = None
    samples: tuple[tuple[float, float, float], ...] = ()  # km/h, m, m/s2: each SAMPLE_MS
    events: tuple[LogLine, ...] = ()


def lines_of(
    picture: RunPicture, columns: int, rows: int, foot: Sequence[Line] = (), *, bars: bool = True
) -> list[Line]:
    """The picture in `rows` lines, the last of which are `foot`."""
    foot = foot[: rows - 1]
    car, road = _car(picture), _road(picture, columns)
    head: list[str | Line] = [_title(picture, columns), car, road, _serves(picture)]
    if rows >= ROWS_FOR_COUNTS:
        head += _counts(picture)
    if rows >= ROWS_FOR_PLOTS and bars and picture.samples:
        head += ["", *_plots(picture, columns)]
    if rows >= ROWS_FOR_COUNTS:
        head.append("")
    lines = [_line(one) for one in head[: rows - len(foot)]]
    room = rows - len(lines) - len(foot)
    lines += [_event(one) for one in picture.events[-room:]] if room else []
    lines += [()] * (rows - len(lines) - len(foot))
    return [*lines, *foot]


def _line(found: str | Line) -> Line:
    return (StyledText(found),) if isinstance(found, str) else found


def _title(picture: RunPicture, columns: int) -> Line:
    adapting = "  adapting" if picture.state is not None and picture.state.adapting else ""
    return (StyledText(f" {picture.title}{adapting}".ljust(columns), Style.TITLE),)


def _car(picture: RunPicture) -> Line:
    """The stage first, since a narrow screen has to show it."""
    if (car := picture.telemetry) is not None:
        if collides(car):
            stage = StyledText("COLLISION", Style.ALARM)
        else:
            stage = StyledText(f"{STAGES[car.stage]:<9}", STYLES_OF_STAGES[car.stage])
        return stage, StyledText(
            f"{car.t_ms / 1e3:7.2f} s {car.speed_ms * KMH_PER_MS:6.1f} km/h"
            f"  {_gap(car.gap_m)}{_ttc(car.ttc_s)}  {car.deceleration_ms2:4.1f} m/s2"
        )
    if (seen := picture.sight) is not None:
        stage = StyledText(f"{STAGES[seen.stage]:<9}", STYLES_OF_STAGES[seen.stage])
        speed = "speed unknown" if seen.speed_ms is None else f"{seen.speed_ms * KMH_PER_MS:6.1f} km/h"
        gap = "radar unknown" if seen.targets is None else _gap(seen.range_m)
        more = f"  {seen.targets} targets" if (seen.targets or 0) > 1 else ""
        return stage, StyledText(
            f"{seen.t_ms / 1e3:7.2f} s {speed}  {gap}{_ttc(seen.ttc_s)}"
            f"  asks for {seen.deceleration_ms2:.1f} m/s2{more}"
        )
    if picture.state is None:
        return (StyledText("starting", Style.FAINT),)
    if not picture.load:
        return (StyledText("waiting for the first request", Style.FAINT),)
    answered = picture.state.requests.answered if picture.state.requests is not None else 0
    return (StyledText(f"{answered} of {picture.load} requests answered"),)


def collides(car: Telemetry) -> bool:
    """The gap of a drive is 0 from contact on, and never before."""
    return car.gap_m is not None and car.gap_m <= 0.0


def _gap(gap_m: float | None) -> str:
    return "no target    " if gap_m is None else f"gap {gap_m:6.2f} m"


def _ttc(ttc_s: float | None) -> str:
    return " " * 12 if ttc_s is None or ttc_s >= 100 else f"  TTC {ttc_s:4.1f} s"


def _road(picture: RunPicture, columns: int) -> Line:
    """The car, the gap and what is ahead; the width is the longest gap so far."""
    car, seen = picture.telemetry, picture.sight
    if car is None and seen is None:
        return ()
    gap_m = car.gap_m if car is not None else seen.range_m if seen is not None else None
    stage = car.stage if car is not None else seen.stage if seen is not None else STAGE_NONE
    ego, width = StyledText(">", STYLES_OF_STAGES[stage] if stage else Style.STRONG), max(1, columns - 2)
    if gap_m is None:
        return ego, StyledText("." * width, Style.FAINT)
    longest_m = max(ROAD_M, gap_m, *(gap for _, gap, _ in picture.samples))
    cells = min(width, max(0, round(width * gap_m / longest_m)))
    if car is not None and collides(car):
        return ego, StyledText("X", Style.ALARM)
    return ego, StyledText("." * cells, Style.FAINT), StyledText("#", Style.STRONG)


def _serves(picture: RunPicture) -> Line:
    state = picture.state
    if state is None:
        return ()
    style = Style.NOTE if state.adapting else Style.STRONG
    roles = (
        f"  {state.roles}"
        if state.backup or not state.leader
        else f"  {state.leader} alone, epoch {state.epoch}"
    )
    return StyledText(state.ftm, style), StyledText(roles, Style.PLAIN if state.leader else Style.SERIOUS)


def _counts(picture: RunPicture) -> Iterator[str]:
    if picture.state is not None and picture.state.requests is not None:
        yield f"requests: {requests_line(picture.state)}"
    if picture.bus:
        yield picture.bus


def _plots(picture: RunPicture, columns: int) -> Iterator[str]:
    """Speed, gap and deceleration, a row each; the last samples that fit."""
    named = (("km/h", 0), ("gap m", 1), ("m/s2", 2))
    for name, at in named:
        values = [sample[at] for sample in picture.samples[-max(1, columns - 13) :]]
        most = max(values) or 1.0
        drawn = (BARS[min(len(BARS) - 1, ceil((len(BARS) - 1) * max(0.0, value) / most))] for value in values)
        yield f"{name:<6}{max(values):5.0f} {''.join(drawn)}"


def _event(one: LogLine) -> Line:
    style = STYLES_OF_EVENTS.get(one.event, Style.PLAIN)
    return (
        StyledText(f"{one.t_ms / 1e3:9.3f} s  ", Style.FAINT),
        StyledText(f"{one.event:<13} ", style),
        StyledText(one.text),
    )


# -- a line that is typed -------------------------------------------------------------------------


class Prompt:
    """A line under the picture, typed with the keys of a shell; all prompts of a view share `history`."""

    def __init__(self, command: str, history: list[str]) -> None:
        self.command, self.text = command, ""
        self._at, self._history, self._back = 0, history, 0

    def type(self, key: Key | str) -> None:
        """A character, or a key that edits the line."""
        text, at = self.text, self._at
        match key:
            case str():
                self._set(text[:at] + key + text[at:], at + len(key))
            case Key.ERASE:
                self._set(text[: max(0, at - 1)] + text[at:], at - 1)
            case Key.ERASE_LINE:
                self._set(text[at:], 0)
            case Key.ERASE_WORD:
                kept = text[:at].rstrip().rpartition(" ")
                self._set(kept[0] + kept[1] + text[at:], len(kept[0] + kept[1]))
            case Key.LEFT:
                self._set(text, at - 1)
            case Key.RIGHT:
                self._set(text, at + 1)
            case Key.HOME:
                self._set(text, 0)
            case Key.END:
                self._set(text, len(text))
            case Key.UP | Key.DOWN:
                back = self._back + (1 if key is Key.UP else -1)
                if 0 <= back <= len(self._history):
                    self._back = back
                    found = self._history[-back] if back else ""
                    self._set(found, len(found))

    def _set(self, text: str, at: int) -> None:
        self.text, self._at = text, min(len(text), max(0, at))

    def line(self, columns: int) -> Line:
        """With the cursor, which is always in sight."""
        text, at, room = self.text, self._at, max(1, columns - len(self.command) - 4)
        before, under, behind = text[max(0, at - room + 1) : at], text[at : at + 1] or " ", text[at + 1 :]
        if not cells(under):
            under = f" {under}"
        while before and cells(before) + cells(under) > room:
            before = before[1:]
        return (
            StyledText(f"{self.command}> ", Style.NOTE),
            StyledText(before),
            StyledText(under, Style.TITLE),
            StyledText(behind[: max(0, room - len(before))]),
            StyledText(""),
        )


# -- a command that is under way ------------------------------------------------------------------


class Command:
    """One command of the user's, until it has answered; `descriptor` is readable then."""

    def __init__(self, words: Sequence[str], private: Path) -> None:
        self.words = " ".join(words)
        self._process = start_command(words, private)
        self.descriptor = os.pidfd_open(self._process.pid)
        self._limit_s = time.monotonic() + COMMAND_S_MAX

    def answered(self) -> tuple[bool, str] | None:
        """Whether it succeeded and what it printed, once it has ended; one that takes too long is ended."""
        if linux.ends(self.descriptor, 0.0):
            return self.close()
        if time.monotonic() < self._limit_s:
            return None
        self.close()
        return False, f"no answer within {COMMAND_S_MAX:.0f} s"

    def close(self) -> tuple[bool, str]:
        """End it, if it has not ended."""
        self._process.kill()
        code = self._process.wait()
        assert self._process.stdout is not None
        with self._process.stdout as printed:  # less than a pipe holds
            text = printed.read(ANSWER_CHARACTERS_MAX).strip()
        os.close(self.descriptor)
        return code == 0, text or f"exit code {code}"


# -- the view -------------------------------------------------------------------------------------


class LiveView(RunView):
    """Shows the run on the whole terminal, and takes keys where standard input is one, too."""

    def __init__(self, options: RunOptions, screen: Screen) -> None:
        super().__init__()
        self._private, self._screen = Path(options.private), screen
        self._bars = screen.can_show(BARS)
        self._picture = RunPicture(
            f"aftbed run {options.run}  {options.placement}  seed {options.seed}",
            bus=bus_line(options) if options.port else "",
            load=options.work.count if isinstance(options.work, LoadRun) else 0,
        )
        self._frozen: RunPicture | None = None
        self._events: deque[LogLine] = deque(maxlen=EVENTS_KEPT)
        self._samples: deque[tuple[float, float, float]] = deque(maxlen=SAMPLES_KEPT)
        self._sample_ms = 0
        self._prompt: Prompt | None = None
        self._history: list[str] = []
        self._command: Command | None = None
        self._answer: list[StyledText] = []  # paragraphs
        self._changed, self._due_s = True, 0.0

    # -- what it is told ----------------------------------------------------------------------

    def telemetry(self, car: Telemetry) -> None:
        self._picture.telemetry = car
        self._sample(car.t_ms, car.speed_ms, car.gap_m, car.deceleration_ms2)

    def sight(self, seen: Sight) -> None:
        self._picture.sight = seen
        self._sample(seen.t_ms, seen.speed_ms or 0.0, seen.range_m, seen.deceleration_ms2)

    def state(self, state: ServiceState) -> None:
        self._picture.state, self._changed = state, True

    def event(self, event: dict[str, object]) -> None:
        self._events.append(msgspec.convert(event, LogLine))
        self._changed = True

    def _sample(self, t_ms: int, speed_ms: float, gap_m: float | None, deceleration_ms2: float) -> None:
        self._changed = True
        if t_ms >= self._sample_ms:
            self._sample_ms = t_ms + SAMPLE_MS
            self._samples.append((speed_ms * KMH_PER_MS, gap_m or 0.0, deceleration_ms2))

    # -- the terminal -------------------------------------------------------------------------

    @property
    def takes_keys(self) -> bool:
        return self._screen.has_keys

    @property
    def descriptors(self) -> tuple[int, ...]:
        command = (self._command.descriptor,) if self._command is not None else ()
        return (*self._screen.descriptors, *command)

    @property
    def wait_s(self) -> float:
        return PERIOD_S if self._changed or self._command is not None else IDLE_S

    def attend(self) -> None:
        for key in self._screen.attend():
            self._on_key(key)
        if self._command is not None and (answered := self._command.answered()) is not None:
            self._show_answer(self._command.words, *answered)
            self._command = None
        now_s = time.monotonic()
        if (self._changed or self._screen.is_stale) and now_s >= self._due_s:
            self._due_s = now_s + PERIOD_S
            self._changed = not self._draw()

    def close(self) -> None:
        """End what is under way."""
        if self._command is not None:
            self._command.close()
            self._command = None

    def _draw(self) -> bool:
        columns, rows = self._screen.size
        picture = self._frozen or self._now()
        return self._screen.draw(lines_of(picture, columns, rows, self._foot(columns, rows), bars=self._bars))

    def _now(self) -> RunPicture:
        return msgspec.structs.replace(
            self._picture, samples=tuple(self._samples), events=tuple(self._events)
        )

    def _foot(self, columns: int, rows: int) -> list[Line]:
        """The answer, and the line of the keys or of what is typed."""
        most = len(HELP) if self._is_help else LINES_OF_ANSWER_MAX
        answer = (
            (StyledText(line, style),)
            for text, style in self._answer
            for line in textwrap.wrap(text, max(10, columns))
        )
        lines: list[Line] = list(islice(answer, max(0, min(rows - 4, most))))
        if self._prompt is not None:
            return [*lines, self._prompt.line(columns)]
        if not self.takes_keys:
            return lines
        frozen = (StyledText(" FROZEN ", Style.TITLE), StyledText(" ")) if self._frozen is not None else ()
        return [*lines, (*frozen, StyledText(KEY_LINE, Style.FAINT))]

    # -- keys ---------------------------------------------------------------------------------

    def _on_key(self, key: Key | str) -> None:
        self._changed = True
        if self._prompt is not None:
            self._on_key_in(self._prompt, key)
            return
        match key:
            case "p":
                self._frozen = self._now() if self._frozen is None else None
            case "i":
                self._prompt = Prompt("inject", self._history)
            case "a":
                self._prompt = Prompt("adapt", self._history)
            case "q":
                self._send(["stop"])
            case "y" | "n":
                self.decide(key)
            case "?":
                self._answer = [] if self._is_help else [StyledText(line) for line in HELP]
            case Key.ESCAPE:
                self._answer = []

    def _on_key_in(self, prompt: Prompt, key: Key | str) -> None:
        if key is Key.ESCAPE:
            self._prompt = None
        elif key is not Key.ENTER:
            prompt.type(key)
        else:
            self._prompt = None
            if line := prompt.text.strip():
                self._history.append(line)
                self._send_line(prompt.command, line)

    @property
    def _is_help(self) -> bool:
        return [one.text for one in self._answer] == list(HELP)

    def _send_line(self, command: str, line: str) -> None:
        """As `aftbed inject "crash primary"`, or `aftbed adapt compose lfr+tr`."""
        try:
            words = [line] if command == "inject" and " " in line else shlex.split(line)
        except ValueError:
            self._show_answer(f"{command} {line}", False, "quotation marks come in pairs")
            return
        self._send([command, *words])

    def _send(self, words: Sequence[str]) -> None:
        if self._command is not None:
            self._show_answer(" ".join(words), False, f"{self._command.words} is under way: wait for it")
            return
        try:
            self._command = Command(words, self._private)
        except OSError as error:
            self._show_answer(" ".join(words), False, f"not sent: {error.strerror}")
            return
        self._answer = [StyledText(f"{self._command.words}: sent", Style.FAINT)]

    def _show_answer(self, words: str, done: bool, text: str) -> None:
        style, lines = Style.GOOD if done else Style.SERIOUS, shown(text).splitlines()
        self._answer = [StyledText(words, Style.STRONG), *(StyledText(line, style) for line in lines)]
        self._changed = True
