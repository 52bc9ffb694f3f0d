"""What may stand at the cursor of a command line that is being typed: names, choices, options, files.

`complete` reads the words as a shell has them, with their quotes. Commands and options are those of the typer
app; typer's own completion parses the line with pydantic (80 ms of each TAB) and knows no words inside of
quotes. What the value of an option or an argument may be is found in this order:

1. `VALUES`, by the name of the option or argument, alone or behind its command;
2. its metavar, if that lists choices (`process|replica`);
3. its type: a file where it is a path.

Nothing is asked that could block: names of live runs come from their directories, and the run that is asked
for its graph has `ASK_SECONDS_MAX`. Without an answer, the graph of `pbr` stands for it.
"""

import contextlib
import importlib
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Any, Final, NamedTuple

import msgspec
import typer

from aftbed.cli.app import app
from aftbed.cli.lazy import LazyCommand
from aftbed.core.errors import ConfigError, HarnessError

ASK_SECONDS_MAX: Final = 0.15
MANY: Final = 60  # of more words, only the parts up to the next dot are offered
WIDTH: Final = 70  # of what is said about a word
BREAKS: Final = ("=", ":")  # bash makes words of their own of them

# -- the answer -----------------------------------------------------------------------------------


class How(StrEnum):
    """How a shell inserts what it is offered."""

    WORDS = "words"
    QUOTED = "quoted"  # as it is: it begins with a quote that is not closed yet
    FILES = "files"  # those that the shell finds itself
    FOLDERS = "folders"


class Offer(NamedTuple):
    """What may stand at the cursor, each with what is to be said about it."""

    how: How = How.WORDS
    words: Sequence[tuple[str, str]] = ()

    def lines(self) -> list[str]:
        """For the scripts in `shells`."""
        return [self.how, *(f"{word}\t{about}" if about else word for word, about in self.words)]


NOTHING: Final = Offer()


class TypedLine(NamedTuple):
    """The words before the cursor, read; `word` is the unfinished one, without its quote."""

    path: str  # of the command, as `inject crash`
    command: Any  # of typer
    options: Mapping[str, Sequence[str]]
    arguments: Sequence[str]
    awaiting: Any  # the option whose value stands at the cursor, None for none
    only_arguments: bool  # behind `--`
    word: str
    quoted: bool

    def option(self, name: str) -> str | None:
        """Its last value."""
        return next(iter(reversed(self.options.get(name, ()))), None)


def complete(words: Sequence[str]) -> Offer:
    """What may stand at the end of `words`, the last of which is unfinished; "" if it has not begun."""
    joined, cut = _joined(words)
    *before, last = joined
    word, quoted = _plain(last)
    line = _read(before, word, quoted)
    if line is None:
        return NOTHING
    offer = _offer(line)
    return Offer(offer.how, [(text[cut:], _short(about)) for text, about in offer.words])


def _joined(words: Sequence[str]) -> tuple[list[str], int]:
    """The words as they were typed: bash has `--ftm=pbr` and `r152:m1-60` in three.

    The second value is how much of the last one stands before the word that bash will replace.
    """
    found, cut, glue = list[str](), 0, False
    for word in words:
        if found and (word in BREAKS or glue):
            cut = len(found[-1]) + len(word) * (word in BREAKS)
            found[-1] += word
        else:
            found.append(word)
            cut = 0
        glue = word in BREAKS and bool(found)
    return found, cut


def _plain(word: str) -> tuple[str, bool]:
    """A word without its quotes, and whether one is still open."""
    if word[:1] in ("'", '"') and word.count(word[0]) == 1:
        return word[1:], True
    with contextlib.suppress(ValueError):  # nothing that a shell would have taken
        parts = shlex.split(word)
        return " ".join(parts), False
    return word, False


# -- reading the line -----------------------------------------------------------------------------


def _read(before: Iterable[str], word: str, quoted: bool) -> TypedLine | None:
    """None where there is no such command."""
    path, command = list[str](), typer.main.get_command(app)
    options: dict[str, list[str]] = {}
    arguments, awaiting, ended = list[str](), None, False
    for text in (_plain(raw)[0] for raw in before):
        if awaiting is not None:
            options.setdefault(awaiting.opts[0], []).append(text)
            awaiting = None
        elif text == "--" and not ended:
            ended = True
        elif text.startswith("-") and not ended:
            name, equals, value = text.partition("=")
            found = next((one for one in _options(command) if name in _names(one)), None)
            if found is not None:
                options.setdefault(found.opts[0], []).extend([value] if equals else [])
                awaiting = None if equals or found.is_flag else found
        elif _subcommands(command):
            whole = getattr(command, "WHOLE", "") if " " in text else ""
            inner = _subcommands(command).get(whole or text)
            if inner is None:
                return None
            command = inner.load() if isinstance(inner, LazyCommand) else inner
            path.append(whole or text)
            arguments = [text] if whole else []
        else:
            arguments.append(text)
    return TypedLine(" ".join(path), command, options, arguments, awaiting, ended, word, quoted)


def _subcommands(command: Any) -> Mapping[str, Any]:
    return getattr(command, "commands", {})


def _options(command: Any) -> list[Any]:
    return [one for one in command.params if one.param_type_name == "option" and not one.hidden]


def _names(option: Any) -> tuple[str, ...]:
    return (*option.opts, *option.secondary_opts)


# -- what may stand there -------------------------------------------------------------------------


def _offer(line: TypedLine) -> Offer:
    if line.awaiting is not None:
        return _values(line, line.awaiting, line.awaiting.opts[0])
    if line.word.startswith("-") and not line.only_arguments:
        name, equals, value = line.word.partition("=")
        option = next((one for one in _options(line.command) if name in _names(one)), None)
        if not equals:
            return _matching(line.word, _other_options(line))
        if option is None or option.is_flag:
            return NOTHING
        text, quoted = _plain(value)
        offer = _values(line._replace(word=text, quoted=quoted), option, option.opts[0])
        return offer._replace(words=[(f"{name}={word}", about) for word, about in offer.words])
    if commands := _subcommands(line.command):
        whole = getattr(line.command, "WHOLE", "")
        if whole and (line.quoted or " " in line.word):
            inner = commands[whole]
            return _argument(line._replace(path=f"{line.path} {whole}", command=inner))
        known = ((name, one.help or "") for name, one in commands.items() if not one.hidden)
        return _matching(line.word, known)
    return _argument(line)


def _argument(line: TypedLine) -> Offer:
    places = [one for one in line.command.params if one.param_type_name == "argument"]
    at = len(line.arguments)
    place = places[at] if at < len(places) else next((one for one in places[-1:] if one.nargs == -1), None)
    if place is not None:
        return _values(line, place, place.name)
    return NOTHING if line.word else _matching("", _other_options(line))


def _other_options(line: TypedLine) -> Iterator[tuple[str, str]]:
    """Those that can still be given."""
    for option in _options(line.command):
        if option.multiple or option.opts[0] not in line.options:
            yield from ((name, option.help or "") for name in _names(option))
    yield "--help", "What the command does, and its options."


def _values(line: TypedLine, parameter: Any, name: str) -> Offer:
    known = VALUES.get(f"{line.path} {name}", VALUES.get(name))
    if known is None:
        if choices := _choices(parameter.metavar or ""):
            return _matching(line.word, choices)
        return Offer(How.FILES) if _is_path(line.command, parameter.name) else NOTHING
    return known(line)


def _choices(metavar: str) -> list[tuple[str, str]]:
    """Of `process|replica`; what is in capitals is no choice but the name of a value."""
    found = metavar.strip("[]<>").split("|")
    return [(one, "") for one in found if len(found) > 1 and re.fullmatch(r"[a-z0-9][a-z0-9_-]*", one)]


def _is_path(command: Any, name: str) -> bool:
    """Whether the function behind the command takes a path for it."""
    annotation = getattr(command.callback, "__annotations__", {}).get(name)
    return "Path" in str(annotation)


def _matching(word: str, known: Iterable[tuple[str, str]]) -> Offer:
    found = {text: about for text, about in known if text.startswith(word)}
    if len(found) > MANY:
        found = {_up_to_dot(text, len(word)): "" for text in found}
    return Offer(How.WORDS, list(found.items()))


def _up_to_dot(text: str, begin: int) -> str:
    dot = text.find(".", begin)
    return text if dot < 0 else text[: dot + 1]


def _short(about: str) -> str:
    """Its first sentence or line, as far as there is room."""
    first = about.strip().partition("\n")[0]
    return first if len(first) <= WIDTH else f"{first[: WIDTH - 3].rstrip()}..."


# -- kinds of values ------------------------------------------------------------------------------

Values = Callable[[TypedLine], Offer]
Names = Callable[[TypedLine], Iterable[str]]


def _names_of(names: Names) -> Values:
    return lambda line: _matching(line.word, ((name, "") for name in names(line)))


def _names_or_files(names: Names) -> Values:
    """Files where no name begins so."""

    def offer(line: TypedLine) -> Offer:
        found = _matching(line.word, ((name, "") for name in names(line)))
        return found if found.words else Offer(How.FILES)

    return offer


def _separated(names: Names) -> Values:
    """Several of them, with commas."""

    def offer(line: TypedLine) -> Offer:
        *given, last = line.word.split(",")
        begin = "".join(f"{name}," for name in given)
        known = ((f"{begin}{name}", "") for name in names(line._replace(word=last)) if name not in given)
        return _matching(line.word, known)

    return offer


def _text(following: Callable[[TypedLine, list[str]], Iterable[str]]) -> Values:
    """Words with spaces between them, as one word of the shell: in quotes.

    A shell closes the quotes behind the only text that is offered. So where more may follow, all that begins
    so is offered: the shell inserts what they share, and leaves the quotes open.
    """

    def offer(line: TypedLine) -> Offer:
        done = [word for word in line.word.split(" ")[:-1] if word]
        begin = "".join(f"{word} " for word in done)
        found = _matching(line.word, ((f"{begin}{word}", "") for word in following(line, done))).words
        while len(found) == 1 and (line.quoted or begin):
            only = found[0][0]
            longer = [(f"{only} {word}", "") for word in following(line, only.split())]
            if not longer:
                break
            found = longer
        if line.quoted:
            return Offer(How.WORDS, found)
        return Offer(How.QUOTED, [(f'"{word}', about) for word, about in found])

    return offer


def _files(line: TypedLine) -> Offer:
    return Offer(How.FILES)


def _folders(line: TypedLine) -> Offer:
    return Offer(How.FOLDERS)


# -- names ----------------------------------------------------------------------------------------
# What a command needs for itself is imported with it; the rest is imported here, where it is asked for.


def _mechanisms(line: TypedLine) -> list[str]:
    """Expressions one mechanism longer than what stands before the last `+`; two if only one begins so."""
    begin = line.word.rpartition("+")[0]
    found = [one for one in _longer(begin) if one.startswith(line.word)]
    return [*found, *_longer(found[0])] if len(found) == 1 else found


def _longer(expression: str) -> list[str]:
    """A package that brings a mechanism is imported only to see whether it composes."""
    from aftbed.ftm.compose import NONE, parse  # noqa: PLC0415
    from aftbed.ftm.registry import names  # noqa: PLC0415

    if not expression:
        return [NONE, *names()]
    found = list[str]()
    for name in names():
        with contextlib.suppress(ConfigError):
            parse(f"{expression}+{name}")
            found.append(f"{expression}+{name}")
    return found


def _scenarios(line: TypedLine) -> list[str]:
    """With the rows of a table behind its name and the colon."""
    from aftbed.vehicle.scenarios.library import scenario_names  # noqa: PLC0415
    from aftbed.vehicle.scenarios.tables import SEPARATOR, cases, table_names  # noqa: PLC0415

    table, colon, _ = line.word.partition(SEPARATOR)
    if colon and table in table_names():
        return [case.name for case in cases(table)]
    return scenario_names()


def _tables(line: TypedLine) -> list[str]:
    from aftbed.vehicle.scenarios.tables import table_names  # noqa: PLC0415

    return table_names()


def _groups(line: TypedLine) -> list[str]:
    from aftbed.vehicle.scenarios.tables import group_names  # noqa: PLC0415

    with contextlib.suppress(ConfigError):
        return group_names(next(iter(line.arguments), ""))
    return []


def _campaigns(line: TypedLine) -> list[str]:
    from aftbed.campaign.spec import shipped  # noqa: PLC0415

    return shipped()


def _policies(line: TypedLine) -> list[str]:
    from aftbed.runtime.unix.closed_loop import policy_names  # noqa: PLC0415

    return policy_names()


def _maps(line: TypedLine) -> list[str]:
    from aftbed.vehicle.replay.map_file import shipped_maps  # noqa: PLC0415

    return shipped_maps()


def _dbcs(line: TypedLine) -> list[str]:
    from aftbed.vehicle.replay.map_file import shipped_dbcs  # noqa: PLC0415

    return shipped_dbcs()


def _fault_classes(line: TypedLine) -> list[str]:
    from aftbed.adapt.suitability import FAULTS  # noqa: PLC0415

    return [str(name) for name in FAULTS]


def _function_faults(line: TypedLine) -> list[str]:
    from aftbed.search.ftti import FunctionFault  # noqa: PLC0415

    return list(FunctionFault)


def _log_formats(line: TypedLine) -> list[str]:
    from aftbed.interop.logs import ENDINGS  # noqa: PLC0415

    return list(dict.fromkeys(ENDINGS.values()))


# -- live runs ------------------------------------------------------------------------------------


def _runs(line: TypedLine) -> list[str]:
    from aftbed.runtime.unix.run_directory import owned_runs  # noqa: PLC0415

    return owned_runs()


def _graph(line: TypedLine) -> Any:
    """That of the run that is meant, live or to be started; that of `pbr` where none answers."""
    from aftbed.ftm.compose import build  # noqa: PLC0415

    with contextlib.suppress(ConfigError, HarnessError):
        if line.path.split(" ")[0] not in ("inject", "adapt"):
            return build(line.option("--ftm") or "pbr", line.option("--placement") or "process")
        from aftbed.core.graph import Graph  # noqa: PLC0415
        from aftbed.runtime.unix import control_client, run_directory  # noqa: PLC0415

        asked = line.option("--run") or ""
        meant = [run for run in _runs(line) if run.startswith(asked)]
        if len(meant) == 1:
            private = run_directory.root() / meant[0]
            found = control_client.ask(private, control_client.GraphQuery(), ASK_SECONDS_MAX)
            return msgspec.convert(found, Graph)
    return build("pbr", "process")


def _behind_fault(line: TypedLine, words: list[str]) -> list[str]:
    from aftbed.inject.model import next_words  # noqa: PLC0415

    return next_words(words, _graph(line))


def _behind_bus_fault(line: TypedLine, words: list[str]) -> list[str]:
    from aftbed.inject.bus import BUS, BusFault  # noqa: PLC0415

    if not words:
        return list(BusFault.NAMES)
    return [BUS] if BUS in _behind_fault(line, words) else _behind_fault(line, words)


def _behind_radar(line: TypedLine) -> list[str]:
    from aftbed.inject.radar import RADAR  # noqa: PLC0415

    return _behind_fault(line, [RADAR, *line.arguments])


def _subjects(line: TypedLine) -> list[str]:
    """What a fault of this name can hit; the bus has a command of its own."""
    from aftbed.inject.bus import BUS  # noqa: PLC0415

    kind = line.path.rpartition(" ")[2]
    return [name for name in _behind_fault(line, [kind]) if name != BUS]


def _events(line: TypedLine) -> list[str]:
    from aftbed.inject.targets import events_in  # noqa: PLC0415

    return events_in(_graph(line))


def _replicas(line: TypedLine) -> list[str]:
    from aftbed.inject.targets import replicas, roles_in  # noqa: PLC0415

    graph = _graph(line)
    return [*roles_in(graph), *replicas(graph)]


def _behind_when(line: TypedLine, words: list[str]) -> list[str]:
    """`ttc < 1.2`."""
    return _behind_fault(line, ["crash", "primary", "when", *words]) if len(words) < 3 else []


def _bricks(line: TypedLine) -> list[str]:
    """As `adapt update` names them: without their replica, and the function as `app`."""
    from aftbed.adapt.planner import APPLICATION  # noqa: PLC0415

    parts = dict.fromkeys(brick.part for brick in _graph(line).bricks if brick.replica is not None)
    return [APPLICATION, *(part for part in parts if part != "watchdog")]


def _goals(line: TypedLine) -> list[str]:
    """Expressions to which the verb of the command leads from what runs."""
    from aftbed.adapt.commands import Wish, goal  # noqa: PLC0415
    from aftbed.ftm.compose import EXPRESSIONS, NONE  # noqa: PLC0415

    running, verb = _graph(line).ftm, line.path.rpartition(" ")[2]
    found = list[str]()
    for expression in {*EXPRESSIONS, *_longer(running), *_mechanisms(line)} - {NONE}:
        with contextlib.suppress(ConfigError):
            goal(Wish(verb if verb != "plan" else "to", expression), running)
            found.append(expression)
    return sorted(found)


def _behind_adaptation(line: TypedLine, words: list[str]) -> list[str]:
    """`compose lfr+tr at request 120`."""
    from aftbed.adapt.commands import VERBS  # noqa: PLC0415

    match words:
        case []:
            return list(VERBS)
        case ["update"]:
            return _bricks(line)
        case ["update", _]:
            return ["to"]
        case ["to" | "switch" | "compose" as verb]:
            return _goals(line._replace(path=f"run {verb}", word=line.word.rpartition(" ")[2]))
        case [*_, "at"]:
            return ["request"]
        case [*_, "at", "request"]:
            return ["10", "120"]
        case [*_, "after"]:
            return ["500ms", "2s"]
        case ["update", _, "to"] | [*_, "at" | "after", _] | [*_, "request", _]:
            return []
        case _:
            return ["at", "after"]


def _one_of(*choices: str) -> Values:
    return _names_of(lambda line: choices)


def _choices_in(place: str) -> Values:
    """Those of a constant, MODULE:NAME."""
    module, _, name = place.partition(":")
    return _names_of(lambda line: getattr(importlib.import_module(f"aftbed.{module}"), name))


VALUES: Final[Mapping[str, Values]] = {
    "--ftm": _names_of(_mechanisms),
    "explore crash --ftm": _separated(_mechanisms),
    "explore adapt --ftm": _separated(_mechanisms),
    "explore pairs --ftm": _separated(_mechanisms),
    "explore order --ftm": _separated(_mechanisms),
    "scenario table --ftm": _separated(_mechanisms),
    "--set": _separated(_mechanisms),
    "bench adapt --from": _names_of(_mechanisms),
    "bench adapt --to": _names_of(_mechanisms),
    "adapt plan --from": _names_of(_mechanisms),
    "expr": _names_of(_goals),
    "ftm show expr": _names_of(_mechanisms),
    "brick": _names_of(_bricks),
    "adapt update --to": _files,
    "--scenario": _names_or_files(_scenarios),
    "scenario show name": _names_or_files(_scenarios),
    "scenario run name": _names_or_files(_scenarios),
    "names": _names_or_files(_scenarios),
    "scenario table name": _names_of(_tables),
    "--group": _names_of(_groups),
    "scenario ftti --fault": _separated(_function_faults),
    "ftm check --faults": _separated(_fault_classes),
    "--policy": _names_or_files(_policies),
    "--map": _names_or_files(_maps),
    "map check name": _names_or_files(_maps),
    "--dbc": _names_or_files(_dbcs),
    "campaign plan name": _names_or_files(_campaigns),
    "campaign run name": _names_or_files(_campaigns),
    "--run": _names_of(_runs),
    "--inject": _text(_behind_fault),
    "inject fault words": _text(_behind_fault),
    "inject bus words": _text(_behind_bus_fault),
    "inject radar words": _names_of(_behind_radar),
    "target": _names_of(_subjects),
    "channel": _names_of(_subjects),
    "place": _names_of(_subjects),
    "--at": _names_of(_events),
    "--when": _text(_behind_when),
    "--replica": _names_of(_replicas),
    "--level": _one_of("value", "memory"),
    "--adapt": _text(_behind_adaptation),
    "--placement": _choices_in("core.graph:PLACEMENTS"),
    "--recipe": _choices_in("core.script:RECIPES"),
    "--pace": _one_of("real", "max"),
    "--approve": _choices_in("runtime.unix.closed_loop:APPROVALS"),
    "--brake-policy": _choices_in("cli.run:POLICIES"),
    "--format": _choices_in("cli.live:FORMATS"),
    "--runtime": _choices_in("cli.campaign:RUNTIMES"),
    "--executor": _choices_in("cli.campaign:EXECUTORS"),
    "--kind": _choices_in("cli.new_function:KINDS"),
    "schema kind": _choices_in("cli.schema:SHAPES"),
    "log convert --from": _names_of(_log_formats),
    "log convert --to": _names_of(_log_formats),
    "--app": _files,
    "source": _files,
    "file": _files,
    "--replay": _files,
    "--requests": _files,
    "--expect": _files,
    "--diagram": _files,
    "--table": _files,
    "--record": _folders,
    "--out": _files,
    "record": _folders,
    "folder": _folders,
    "folders": _folders,
    "campaign compare base": _folders,
    "campaign compare new": _folders,
    "--trust": _folders,
    "--against": _folders,
}
