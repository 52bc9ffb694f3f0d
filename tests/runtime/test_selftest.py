"""The self-test of what is written off line: whatever it does wrong is found before it gets a channel."""

from pathlib import Path
from typing import Final

import msgspec
import pytest

from aftbed.adapt.plugins import make_brick
from aftbed.core.brick import Brick, Effect, Send
from aftbed.core.errors import ConfigError
from aftbed.core.graph import BrickSpec, Graph, Kind
from aftbed.core.messages import AnyMessage, Reply
from aftbed.ftm.chain import Compute
from aftbed.ftm.compose import EXPRESSIONS, NONE, build
from aftbed.ftm.registry import KINDS, Setting
from aftbed.functions.load import NO_CODE, OWN_CODE, load_application, load_class
from aftbed.runtime.assembly import TEST_EPOCH, MakeBrick, self_test
from aftbed.vehicle.aeb.function import default_application, sample_requests

REQUESTS = tuple(sample_requests(0, 8))
SOURCE = f"{__name__}:Any"


class Wrapped:
    """A Proceed that is one, and whose misbehaviour is the test's."""

    KIND: Kind = KINDS["compute.proceed"]

    def __init__(self, setting: Setting) -> None:
        self.inner = Compute()

    def open_ports(self) -> tuple[str, ...]:
        return self.inner.open_ports()

    def quiescent(self) -> bool:
        return self.inner.quiescent()

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        return self.change(self.inner.step(port, msg, now_ns))

    def change(self, effects: list[Effect]) -> list[Effect]:
        return effects


class Silent(Wrapped):
    def change(self, effects: list[Effect]) -> list[Effect]:
        return [e for e in effects if not (isinstance(e, Send) and e.port == "prd2aft")]


class Lying(Wrapped):
    def change(self, effects: list[Effect]) -> list[Effect]:
        return [_another(e) for e in effects]


class Circling(Wrapped):
    """Asks the Server again and again."""

    def step(self, port: str, msg: AnyMessage, now_ns: int) -> list[Effect]:
        effects = super().step(port, msg, now_ns)
        if isinstance(msg, Reply):
            raise RuntimeError("lost my way")
        return effects


def _another(effect: Effect) -> Effect:
    if isinstance(effect, Send) and isinstance(effect.message, Reply):
        return Send(effect.port, msgspec.structs.replace(effect.message, payload=b"lie"))
    return effect


def _with(graph: Graph, kind: type) -> tuple[Graph, MakeBrick]:
    bricks = tuple(
        msgspec.structs.replace(b, source=SOURCE) if b.part == "proceed" else b for b in graph.bricks
    )

    def make(spec: BrickSpec) -> Brick:
        setting = Setting(1, TEST_EPOCH, True, default_application)
        if spec.source:
            found: Brick = kind(setting)
            return found
        return make_brick(spec, setting, NO_CODE)

    return msgspec.structs.replace(graph, bricks=bricks), make


@pytest.mark.parametrize("expression", [e for e in EXPRESSIONS if e != NONE])
def test_every_mechanism_passes_its_own_test(expression: str) -> None:
    graph, make = _with(build(expression, "process"), Wrapped)
    plain = msgspec.structs.replace(
        graph, bricks=tuple(msgspec.structs.replace(b, source="") for b in graph.bricks)
    )
    self_test(plain, "a", make, REQUESTS)


def test_a_sound_brick_passes() -> None:
    graph, make = _with(build("pbr", "process"), Wrapped)
    self_test(graph, "a", make, REQUESTS)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        (Silent, "recorded request 1 is never answered"),
        (Lying, "recorded request 1: the reply is 6c6965, wanted is "),
        (Circling, "a/proceed: Reply on srv2prd: RuntimeError: lost my way"),
    ],
)
def test_what_is_wrong_is_named(kind: type, words: str) -> None:
    graph, make = _with(build("pbr", "process"), kind)
    with pytest.raises(ConfigError, match="self-test: ") as refusal:
        self_test(graph, "a", make, REQUESTS)
    assert words in str(refusal.value)


# -- functions


FUNCTIONS: Final = """
from aftbed.bench.ballast import TrackedBallast
from aftbed.vehicle.aeb.function import AebFunction

class Text(AebFunction):
    def execute(self, request): return "brake"

class Nothing(AebFunction):
    def execute(self, request): return None

class Endless(AebFunction):
    def execute(self, request): return bytes(100_000_000)

class Breaking(AebFunction):
    def execute(self, request): raise KeyError("speed")

class StateText(AebFunction):
    def capture(self): return "state"

class StateEndless(AebFunction):
    def capture(self): return bytes(100_000_000)

class Forgetful(AebFunction):
    def restore(self, state): raise IndexError("out of range")

class Sound(AebFunction):
    pass

class Tracked(TrackedBallast):
    size_bytes = 20_000

class Unaware(Tracked):
    def changes(self, page_bytes): return {}

class Careless(Tracked):
    def patch(self, page_bytes, pages): pass

class Growing(Tracked):
    def execute(self, request):
        self._state.append(1)
        return super().execute(request)
    def restore(self, state): self._state[:] = state

class Rude(Tracked):
    def changes(self, page_bytes): raise KeyError("no page")

class Half(AebFunction):
    def changes(self, page_bytes): return {}
"""


def try_out(tmp_path: Path, name: str, ftm: str = "pbr") -> None:
    """The self-test of the function of that name."""
    path = tmp_path / "functions.py"
    path.write_text(FUNCTIONS)
    source = f"{path}:{name}"
    function, graph = load_application(source, OWN_CODE), build(ftm, "process")
    bricks = tuple(
        msgspec.structs.replace(b, application=source) if b.part == "server" else b for b in graph.bricks
    )
    setting = Setting(1, TEST_EPOCH, True, function)
    graph = msgspec.structs.replace(graph, bricks=bricks)
    self_test(graph, "a", lambda spec: make_brick(spec, setting, NO_CODE), REQUESTS)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("Text", "a/server: Request on prd2srv: Text: execute returned str, bytes are required"),
        ("Nothing", "execute returned NoneType, bytes are required"),
        ("Endless", "execute returned 100000000 bytes, at most 61440 are allowed"),
        ("Breaking", "KeyError: 'speed'"),
        ("StateText", "capture returned str, bytes are required"),
        ("Unaware", "changes and patch do not give the state of capture"),
        ("Careless", "changes and patch do not give the state of capture"),
        ("Growing", "changes and patch do not give the state of capture"),
        ("Rude", "KeyError: 'no page'"),
        ("Half", "it has changes, and not the other one"),
        ("StateEndless", "capture returned 100000000 bytes, at most 67108864 are allowed"),
    ],
)
def test_a_function_that_answers_nonsense_is_refused_with_the_reason(
    tmp_path: Path, name: str, words: str
) -> None:
    with pytest.raises(ConfigError, match="self-test: ") as refusal:
        try_out(tmp_path, name)
    assert words in str(refusal.value)


def test_a_function_that_does_not_restore_is_refused_with_the_reason(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"self-test: .*: restore: Forgetful: IndexError: out of range"):
        try_out(tmp_path, "Forgetful")


def test_a_sound_function_passes(tmp_path: Path) -> None:
    try_out(tmp_path, "Sound", "lfr+tr")


@pytest.mark.parametrize("ftm", ["pbr", "pbr+tr", "lfr"])
def test_a_function_that_knows_its_changes_passes(tmp_path: Path, ftm: str) -> None:
    try_out(tmp_path, "Tracked", ftm)


# -- loading


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("nowhere", "names no class"),
        (":X", "names no class"),
        ("a.module:", "names no class"),
    ],
)
def test_a_source_that_names_no_class(source: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_class(source, NO_CODE)


def test_a_brick_is_no_function() -> None:
    with pytest.raises(ConfigError, match="is no protected function: it lacks execute"):
        load_application("aftbed.ftm.chain:Compute", OWN_CODE)
    with pytest.raises(ConfigError, match=r"has no class Comput \(it has: .*Compute"):
        load_application("aftbed.ftm.chain:Comput", OWN_CODE)
    with pytest.raises(ConfigError, match="cannot be imported: ModuleNotFoundError"):
        load_application("aftbed.ftm.nothing:Compute", OWN_CODE)
