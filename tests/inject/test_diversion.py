"""What a disturbed channel sends: pure, in made-up time. Order is kept, and nothing is held back for ever."""

from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.fault import Disturb, How
from aftbed.core.messages import CaptureState, Message
from aftbed.core.persistence import ONCE, Every, Permanent, Persistence
from aftbed.runtime import control
from aftbed.runtime.diversion import BITTEN, STRUCK, Diversion, Meddler

BY_NS = 10


def message(number: int) -> Message:
    return CaptureState(1, number)


class Channel:
    """A diverted channel, and what it has sent and written down."""

    def __init__(self) -> None:
        self.diversion = Diversion()
        self.sent: list[int] = []
        self.notes: list[tuple[int, int, int]] = []

    def add(self, how: How, nth: int = 1, persistence: Persistence = ONCE, fault: int = 7) -> "Channel":
        blow = control.Blow(
            fault, "a/after", nth, Disturb(how, "aft2aft", BY_NS / 1e6), False, 5, persistence
        )
        note = lambda what, about: self.notes.append((fault, what, about))  # noqa: E731
        self.diversion.add(fault, Meddler(blow, note))
        return self

    def send(self, *numbers: int, at_ns: int = 0) -> "Channel":
        for number in numbers:
            self._out(self.diversion.take(message(number), at_ns))
        return self

    def wait(self, until_ns: int) -> "Channel":
        self._out(self.diversion.release(until_ns))
        return self

    def _out(self, messages: list[Message]) -> None:
        for sent in messages:
            assert isinstance(sent, CaptureState)
            self.sent.append(sent.request_id)


def test_an_omitted_message_is_not_sent() -> None:
    channel = Channel().add(How.OMISSION, nth=2).send(1, 2, 3)
    assert channel.sent == [1, 3] and channel.notes == [(7, BITTEN, 2)] and channel.diversion.over


def test_a_duplicate_is_sent_twice() -> None:
    channel = Channel().add(How.DUPLICATE, nth=2).send(1, 2, 3)
    assert channel.sent == [1, 2, 2, 3] and channel.notes == [(7, BITTEN, 2)] and channel.diversion.over


def test_a_delayed_message_comes_in_its_time_and_what_is_behind_it_too() -> None:
    channel = Channel().add(How.DELAY, nth=2).send(1, 2).send(3, at_ns=4)
    assert channel.sent == [1] and channel.diversion.due_ns() == BY_NS and not channel.diversion.over
    assert channel.wait(BY_NS - 1).sent == [1]
    assert channel.wait(BY_NS).sent == [1, 2, 3] and channel.diversion.over
    assert channel.notes == [(7, STRUCK, 2), (7, BITTEN, 2)], "of what merely waited there is nothing to say"


def test_a_message_that_comes_behind_the_time_sends_what_was_due() -> None:
    assert Channel().add(How.DELAY).send(1).send(2, at_ns=BY_NS).sent == [1, 2]


def test_a_lasting_delay_is_as_long_for_each() -> None:
    channel = Channel().add(How.DELAY, persistence=Permanent()).send(1).send(2, at_ns=4)
    assert channel.wait(BY_NS).sent == [1] and channel.diversion.due_ns() == BY_NS + 4
    assert channel.wait(BY_NS + 4).sent == [1, 2]


def test_a_successor_goes_ahead() -> None:
    channel = Channel().add(How.REORDER, nth=2).send(1, 2, 3, 4)
    assert channel.sent == [1, 3, 2, 4] and channel.notes == [(7, STRUCK, 2), (7, BITTEN, 2)]


def test_without_a_successor_it_is_late_and_nothing_has_changed_places() -> None:
    channel = Channel().add(How.REORDER).send(1)
    assert channel.wait(BY_NS).sent == [1] and channel.notes == [(7, STRUCK, 1)] and channel.diversion.over


def test_two_faults_of_one_channel_stand_one_behind_the_other() -> None:
    channel = Channel().add(How.DUPLICATE, fault=7).add(How.OMISSION, nth=2, fault=8).send(1, 2)
    assert channel.sent == [1, 2] and channel.notes == [(7, BITTEN, 1), (8, BITTEN, 1)]


def test_what_is_stopped_strikes_no_more_and_gives_back_what_it_has() -> None:
    channel = Channel().add(How.DELAY, persistence=Permanent()).send(1)
    channel.diversion.stop(7)
    assert channel.send(2).wait(BY_NS).sent == [1, 2] and channel.diversion.over
    channel.diversion.stop(9)  # there is none


hows = st.tuples(st.sampled_from(How), st.integers(1, 5), st.sampled_from((ONCE, Permanent(), Every(3))))


@given(st.lists(hows, max_size=4), st.lists(st.integers(0, 30), max_size=30))
def test_nothing_is_made_up_and_nothing_is_kept(
    faults: list[tuple[How, int, Persistence]], steps_ns: list[int]
) -> None:
    channel, now_ns = Channel(), 0
    for fault, (how, nth, persistence) in enumerate(faults):
        channel.add(how, nth, persistence, fault)
    for number, step_ns in enumerate(steps_ns):
        now_ns += step_ns
        channel.wait(now_ns).send(number, at_ns=now_ns)
    channel._out(channel.diversion.flush(now_ns))
    assert channel.diversion.due_ns() is None
    kinds = {how for how, _, _ in faults}
    lost = set(range(len(steps_ns))) - set(channel.sent)
    assert set(channel.sent) <= set(range(len(steps_ns)))
    assert not lost or How.OMISSION in kinds
    assert len(channel.sent) == len(set(channel.sent)) or How.DUPLICATE in kinds
    assert channel.sent == sorted(channel.sent) or How.REORDER in kinds
