"""Where faults wait, how they move when the roles or the graph change, and what their receipts say.

The processes here are names with a journal; what a node would do is told to them in its place.
"""

from collections.abc import Callable, Generator, Iterable
from pathlib import Path
from typing import Final

import pytest

from aftbed.core.event import Event
from aftbed.core.fault import Fault, mark
from aftbed.ftm.mechanism import build
from aftbed.inject.words import parse
from aftbed.runtime import control
from aftbed.runtime import faults as faults_module
from aftbed.runtime.faults import Faults
from aftbed.runtime.jobs import StepFailed, Wait
from aftbed.runtime.unix.journal import Journal
from aftbed.runtime.unix.loop import Loop
from aftbed.runtime.unix.support import Support

FIRST: Final = 1_000_001  # the number of a run's first fault


class FakeProcess:
    """A node's process; `wrote` is its journal. A signal kills it, or stops it, at once."""

    def __init__(self, name: str, folder: Path, incarnation: int) -> None:
        self.name, self.pid, self.pidfd, self.kind = name, 10_000 + incarnation, -1, "node"
        path = folder / f"{name.replace('/', '.')}.{incarnation}.journal"
        self.journal, self.wrote = str(path), Journal(path, name)
        self.alive = self.thaws = True
        self.signals: list[int] = []

    def kill(self) -> None:
        self.signals.append(9)
        self.alive = False

    def freeze(self, for_ms: int = 0) -> None:
        self.signals.append(19)

    def thaw(self) -> bool:
        self.signals.append(18)
        return self.thaws

    def stopped(self) -> bool:
        return bool(self.signals)


class FakeSlot:
    """A replica's nodes."""

    def __init__(self, nodes: list[str]) -> None:
        self.nodes = nodes


class FakeDeployment:
    """`told`: the orders, by node. Whoever is killed is dead when the job that did it goes on."""

    def __init__(self, folder: Path, ftm: str, placement: str) -> None:
        self.graph, self.folder = build(ftm, placement), folder
        self.leader, self.backup = "a", "b"
        self.nodes: dict[str, FakeProcess] = {}
        self.told: list[tuple[str, control.Arm | control.Interfere | control.SlowDown]] = []
        self.refuses = False
        self.nursery = self
        self.made = 0
        self.renew(*self.graph.nodes)
        self.slots = {r: FakeSlot([n for n in self.nodes if n.startswith(f"{r}/")]) for r in "ab"}

    @property
    def processes(self) -> list[FakeProcess]:
        return list(self.nodes.values())

    def renew(self, *names: str) -> None:
        for name in names:
            self.made += 1
            self.nodes[name] = FakeProcess(name, self.folder, self.made)

    def lives(self, node: str) -> bool:
        return node in self.nodes and self.nodes[node].alive

    def ask(
        self, node: str, make: Callable[[int], control.Arm | control.Interfere]
    ) -> Generator[Wait, object, bytes]:
        self.told.append((node, make(1)))
        yield Wait(frozenset())
        if self.refuses:
            raise StepFailed(f"{node}: no")
        return b""

    def order_to(
        self, process: FakeProcess, make: Callable[[int], control.SlowDown]
    ) -> tuple[tuple[str, str, int], str]:
        self.told.append((process.name, make(1)))
        return ("ack", process.name, 1), process.name

    def all_of(self, sent: Iterable[object]) -> Generator[Wait, object, None]:
        list(sent)
        yield Wait(frozenset())
        if self.refuses:
            raise StepFailed("no")

    def fail_over(self) -> None:
        for name, process in self.nodes.items():
            if name.startswith("a/") and name != "a/watchdog":
                process.kill()
        self.leader, self.backup = "b", ""


class Run:
    """The faults of a run, and what was said about them."""

    def __init__(self, folder: Path, ftm: str = "pbr", seed: int = 0, placement: str = "process") -> None:
        self.deployment = FakeDeployment(folder, ftm, placement)
        self.said: list[str] = []
        (folder / "journal").mkdir()
        support = Support(
            folder,
            Loop(),
            self.deployment,  # type: ignore[arg-type]
            lambda kind, incarnation: ("", b""),
            lambda event, text: self.said.append(f"{event}: {text}"),
            seed,
        )
        self.deployment.support = support
        self.faults = Faults(self.deployment)  # type: ignore[arg-type]

    def do(self, steps: Generator[Wait, object, None]) -> list[Wait]:
        """Run a job to its end; what it waited for, all of which is so."""
        waits = []
        try:
            waits.append(next(steps))
            while True:
                waits.append(steps.send({}))
        except StopIteration:
            return waits

    def arm(self, text: str) -> Fault:
        fault = parse(text)
        self.do(self.faults.arm(fault))
        return fault

    def blow(self) -> tuple[str, control.Blow]:
        """The node and the blow of the last order."""
        node, order = self.deployment.told[-1]
        assert not isinstance(order, control.SlowDown)
        (blow,) = order.blows if isinstance(order, control.Arm) else (order.blow,)
        return node, blow

    def happened(self, node: str, event: Event, times: int, detail: int = 0, t_ns: int = 2**62) -> None:
        for request_id in range(1, times + 1):
            self.deployment.nodes[node].wrote.write(t_ns, event, request_id, detail)


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run(tmp_path)


# -- where they wait


@pytest.mark.parametrize(
    ("text", "node", "itself"),
    [
        ("crash primary at checkpoint.sent nth 5", "a/after", True),
        ("crash backup at checkpoint.sent nth 5", "a/after", False),
        ("hang primary at checkpoint.sent nth 5", "a/after", False),
        ("bitflip result nth 5", "a/server", False),
        ("bitflip state in b at state.restored nth 5", "b/server", False),
        ("bitflip request nth 5 permanent", "a/server", False),
        ("bitflip checkpoint nth 5", "a/after", False),
        ("bitflip log nth 5", "a/protocol", False),
        ("omission pxy2pro nth 5", "proxy", False),
        ("delay aft2aft nth 5 intermittent p 0.5", "a/after", False),
        ("slow primary at before.exit nth 5", "a/before", False),
    ],
)
def test_a_fault_waits_where_its_event_is_emitted(run: Run, text: str, node: str, itself: bool) -> None:
    fault = run.arm(text)
    host, blow = run.blow()
    assert (host, blow.brick, blow.nth, blow.itself) == (node, node, 5, itself)
    assert (blow.fault, blow.action, blow.persistence) == (FIRST, fault.action, fault.persistence)
    assert run.faults.receipts() == [{"fault": str(fault), "receipt": "armed"}]


def test_a_bitflip_without_an_event_waits_for_the_next_execution(run: Run) -> None:
    run.arm("bitflip result bit 3")
    order = run.deployment.told[-1][1]
    assert isinstance(order, control.Arm) and order.event == "server.exit" and run.blow()[1].nth == 1


def test_a_fault_that_nobody_can_wait_for_is_refused_and_stays_so(run: Run) -> None:
    run.deployment.backup = ""
    with pytest.raises(StepFailed, match=r"nobody emits checkpoint\.applied now"):
        run.arm("crash backup at checkpoint.applied")
    run.deployment.backup = "b"
    run.do(run.faults.rearm())
    assert run.deployment.told == []


def test_the_bit_that_is_not_named_hangs_on_the_seed_and_on_the_fault(tmp_path: Path) -> None:
    draws = []
    for name, seed in (("1", 1), ("2", 2), ("again", 1)):
        (tmp_path / name).mkdir()
        other = Run(tmp_path / name, seed=seed)
        for _ in range(2):
            other.arm("bitflip result")
            draws.append(other.blow()[1].draw)
    assert draws[:2] == draws[4:] and len(set(draws)) == 4


# -- how they move


def test_after_a_failover_a_fault_moves_to_the_new_leader_with_what_was_counted(run: Run) -> None:
    run.happened("a/server", Event.SERVER_EXIT, 500, t_ns=1)  # before
    run.arm("bitflip result nth 100")
    run.happened("a/server", Event.SERVER_EXIT, 40)
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    node, blow = run.blow()
    assert (node, blow.brick, blow.nth) == ("b/server", "b/server", 60)
    run.happened("b/server", Event.SERVER_EXIT, 25)
    run.deployment.renew("b/server")  # another process takes the place: an adaptation
    run.do(run.faults.rearm())
    assert run.blow()[1].nth == 35


def test_what_two_bricks_of_a_node_emit_is_counted_once(tmp_path: Path) -> None:
    run = Run(tmp_path, "pbr+tr", placement="replica")
    run.arm("crash proxy at before.exit nth 100")
    assert (run.blow()[0], run.blow()[1].brick) == ("a", "a/before")
    run.happened("a", Event.BEFORE_EXIT, 80)  # of 40 requests
    run.deployment.nodes["a"].kill()
    run.deployment.leader, run.deployment.backup = "b", ""
    run.do(run.faults.rearm())
    assert (run.blow()[0], run.blow()[1].brick, run.blow()[1].nth) == ("b", "b/before", 60)


def test_what_has_not_changed_stays_where_it_is(run: Run) -> None:
    run.arm("bitflip result nth 100")
    told = len(run.deployment.told)
    run.do(run.faults.rearm())
    assert len(run.deployment.told) == told


def test_a_backup_that_leads_is_no_longer_hit_as_a_backup(tmp_path: Path) -> None:
    run = Run(tmp_path, "lfr")
    run.arm("bitflip result in backup nth 100")
    assert run.blow()[0] == "b/server"
    run.happened("b/server", Event.SERVER_EXIT, 10)
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    node, blow = run.blow()
    assert (node, blow.nth) == ("b/server", 0), "it does not wait there any more"
    run.deployment.renew(*(n for n in run.deployment.graph.nodes if n.startswith("a/")))
    run.deployment.backup = "a"
    run.do(run.faults.rearm())
    node, blow = run.blow()
    assert (node, blow.brick, blow.nth) == ("a/server", "a/server", 90)


# -- what an adaptation comes through


def test_at_a_step_of_an_adaptation_the_target_is_dead_before_it_goes_on(run: Run) -> None:
    fault = run.arm("crash backup at adapt.step.enter nth 3")
    assert run.deployment.told == [], "no node is asked: the supervisor counts"
    for _ in range(2):
        assert run.do(run.faults.at(Event.ADAPT_STEP_ENTER)) == []
    assert run.do(run.faults.at(Event.ADAPT_STEP_EXIT)) == [], "that is another event"
    victims = run.deployment.slots["b"].nodes
    assert all(map(run.deployment.lives, victims))
    (wait,) = run.do(run.faults.at(Event.ADAPT_STEP_ENTER))
    assert wait.keys == {("died", name, run.deployment.nodes[name].pid) for name in victims}
    assert not any(map(run.deployment.lives, victims))
    assert run.faults.receipts() == [{"fault": str(fault), "receipt": "activated"}]
    assert run.do(run.faults.at(Event.ADAPT_STEP_ENTER)) == [], "once"


def test_while_a_step_is_under_way_the_death_is_not_waited_for(run: Run) -> None:
    run.arm("crash b/server at adapt.step.act")
    assert run.do(run.faults.at(Event.ADAPT_STEP_ACT)) == []
    assert not run.deployment.lives("b/server")


def test_each_fault_at_the_same_step_strikes(run: Run) -> None:
    run.arm("crash engine at adapt.commit")
    run.arm("crash proxy at adapt.commit")
    run.do(run.faults.at(Event.ADAPT_COMMIT))
    assert not run.deployment.lives("engine") and not run.deployment.lives("proxy")


def test_an_adaptation_that_never_comes_activates_nothing(run: Run) -> None:
    fault = run.arm("crash engine at adapt.commit")
    run.do(run.faults.rearm())
    assert run.faults.receipts() == [{"fault": str(fault), "receipt": "armed"}]


# -- receipts


@pytest.mark.parametrize(
    ("text", "event", "bits", "receipt", "detail"),
    [
        (
            "bitflip result bit 60",
            Event.FAULT_APPLIED,
            60,
            "activated",
            "bit 60 of the result of request 1 in a/server",
        ),
        (
            "bitflip state",
            Event.FAULT_APPLIED,
            9,
            "applied",
            "bit 9 of the state of request 1 in a/server",
        ),
        (
            "bitflip result bit 300",
            Event.PEER_REFUSED,
            264,
            "not_activated",
            "there are 264 bits of the result of request 1 in a/server",
        ),
        (
            "bitflip state",
            Event.PEER_REFUSED,
            0,
            "not_activated",
            "there are 0 bits of the state of request 1 in a/server",
        ),
        (
            "bitflip state bit 13",
            Event.PEER_REFUSED,
            264,
            "not_activated",
            "the function refused bit 13 of the state of request 1 in a/server",
        ),
    ],
)
def test_the_receipt_of_a_bitflip_says_what_was_hit(
    run: Run, text: str, event: Event, bits: int, receipt: str, detail: str
) -> None:
    fault = run.arm(text)
    run.happened("a/server", Event.PEER_REFUSED, 3)  # some other refusal is no word about a fault
    run.happened("a/server", event, 1, mark(FIRST + 1, 5))  # nor is that about another one
    run.happened("a/server", event, 1, mark(FIRST, bits))
    run.faults.fired(run.deployment.nodes["a/server"], FIRST)  # type: ignore[arg-type]
    assert run.faults.receipts() == [{"fault": str(fault), "receipt": receipt, "detail": detail}]
    assert run.said[-1] == f"fault: {fault}: {receipt}, {detail}"


def test_a_bit_that_was_drawn_and_refused_is_named(run: Run) -> None:
    run.arm("bitflip state")
    draw = run.blow()[1].draw
    run.happened("a/server", Event.PEER_REFUSED, 1, mark(FIRST, 264))
    assert run.faults.receipts()[0]["receipt"] == "not_activated"
    assert f"bit {draw % 264} of the state" in run.faults.receipts()[0]["detail"]


def test_a_node_that_died_with_the_word_in_its_journal_has_said_it(run: Run) -> None:
    fault = run.arm("bitflip result bit 3")
    run.happened("a/server", Event.FAULT_APPLIED, 1, mark(FIRST, 3))
    run.deployment.fail_over()
    told = len(run.deployment.told)
    run.do(run.faults.rearm())
    assert len(run.deployment.told) == told, "one execution was asked for"
    assert run.faults.receipts()[0] == {
        "fault": str(fault),
        "receipt": "activated",
        "detail": "bit 3 of the result of request 1 in a/server",
    }


# -- what lasts, and what is slow


def test_what_has_struck_and_lasts_stays_with_its_process(run: Run) -> None:
    run.arm("bitflip result bit 3 nth 5 permanent")
    run.happened("a/server", Event.FAULT_APPLIED, 1, mark(FIRST, 3))
    told = len(run.deployment.told)
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    run.deployment.renew(*(n for n in run.deployment.graph.nodes if n.startswith("a/")))
    run.deployment.backup = "a"
    run.do(run.faults.rearm())
    assert len(run.deployment.told) == told, "who takes the place is sound"
    assert run.faults.receipts()[0]["receipt"] == "activated"


def test_what_has_not_struck_yet_moves_though_it_will_last(run: Run) -> None:
    run.arm("bitflip result bit 3 nth 5 permanent")
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    assert run.blow()[0] == "b/server"


def test_a_fault_of_a_channel_moves_with_its_sender_and_counts_anew(run: Run) -> None:
    run.arm("delay aft2pro nth 5")
    run.happened("a/after", Event.CHECKPOINT_SENT, 3)
    run.deployment.fail_over()
    run.do(run.faults.rearm())
    assert (run.blow()[0], run.blow()[1].nth) == ("b/after", 5)


def test_a_fault_of_a_channel_that_nobody_writes_any_more_waits(run: Run) -> None:
    run.arm("delay aft2aft nth 5 in a")
    run.deployment.leader, run.deployment.backup = "b", "a"  # b sends there now, and a lives on
    run.do(run.faults.rearm())
    assert (run.blow()[0], run.blow()[1].nth) == ("a/after", 0), "it does not wait there any more"
    assert run.faults.receipts()[0]["receipt"] == "armed"


def test_all_nodes_of_a_slow_replica_are_told_and_told_again(run: Run) -> None:
    run.arm("slow primary by 3ms for 1ms")
    nodes = run.deployment.slots["a"].nodes
    assert run.deployment.told == [(n, control.SlowDown(1, FIRST, 3_000_000)) for n in nodes]
    assert run.faults.receipts()[0]["receipt"] == "applied"
    run.deployment.told.clear()
    loop = run.deployment.support.loop
    loop.after(0.002, loop.end)
    loop.run()
    assert run.deployment.told == [(n, control.SlowDown(1, FIRST, 0)) for n in nodes]
    run.happened("a/after", Event.FAULT_APPLIED, 1, mark(FIRST))
    assert run.faults.receipts()[0]["receipt"] == "activated", "a step has felt it"


# -- when the injector itself fails


@pytest.mark.parametrize("text", ["slow primary", "omission pxy2pro", "bitflip result"])
def test_an_order_that_is_refused_is_the_injectors_failure(run: Run, text: str) -> None:
    run.deployment.refuses = True
    with pytest.raises(StepFailed):
        run.arm(text)
    (receipt,) = run.faults.receipts()
    assert receipt["receipt"] == "inject_error" and receipt["detail"].endswith("no")


def test_a_process_that_will_not_stop_is_the_injectors_failure(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(faults_module, "STOP_NS_MAX", 1_000_000)
    monkeypatch.setattr(FakeProcess, "stopped", lambda self: self.name != "a/server")
    run.arm("hang primary")
    (receipt,) = run.faults.receipts()
    assert receipt["receipt"] == "inject_error"
    assert receipt["detail"] == "not seen stopped within 0.001 s: a/server"


@pytest.mark.parametrize(("thawed", "receipt"), [(True, "activated"), (False, "applied")])
def test_a_hang_is_activated_when_its_target_runs_on(run: Run, thawed: bool, receipt: str) -> None:
    run.arm("hang primary for 1ms")
    assert run.faults.receipts()[0]["receipt"] == "applied"
    for process in run.deployment.processes:
        process.thaws = thawed
    loop = run.deployment.support.loop
    loop.after(0.002, loop.end)
    loop.run()
    assert run.faults.receipts()[0]["receipt"] == receipt


def test_a_crash_is_activated_when_its_target_is_seen_dead(run: Run) -> None:
    run.arm("crash primary at checkpoint.sent")
    run.happened("a/after", Event.FAULT_APPLIED, 1, mark(FIRST))
    assert run.faults.receipts()[0]["receipt"] == "applied"
    run.deployment.nodes["a/after"].kill()
    assert run.faults.receipts()[0]["receipt"] == "activated"


def test_nobody_to_hit_is_said(run: Run) -> None:
    run.deployment.backup = ""
    fault = run.arm("crash backup")
    assert run.faults.receipts() == [
        {"fault": str(fault), "receipt": "not_activated", "detail": "nobody to hit"}
    ]
