"""What a disturbed channel sends: pure, in made-up time. Order is kept, and nothing is held back for ever."""

from hypothesis import given
from hypothesis import strategies as st

from aftbed.core.messages import CaptureState, Message
from aftbed.inject.channel import ALTERED, HELD, ChannelFault, ChannelFilter, Disturbance, FilterStage
from aftbed.inject.grammar import ONCE, Every, Permanent, Persistence

BY_NS = 10


def message(number: int) -> Message:
    return CaptureState(1, number)


class Channel:
    """A channel with a filter, what it has sent, and what was recorded."""

    def __init__(self) -> None:
        self.filter = ChannelFilter()
        self.sent: list[int] = []
        self.notes: list[tuple[int, int, int]] = []

    def add(
        self, how: Disturbance, nth: int = 1, persistence: Persistence = ONCE, fault: int = 7
    ) -> "Channel":
        action = ChannelFault(how, "aft2aft", BY_NS / 1e6)
        record = lambda what, about: self.notes.append((fault, what, about))  # noqa: E731
        self.filter.add(fault, FilterStage(action, nth, persistence, 5, record))
        return self

    def send(self, *numbers: int, at_ns: int = 0) -> "Channel":
        for number in numbers:
            self._out(self.filter.take(message(number), at_ns))
        return self

    def wait(self, until_ns: int) -> "Channel":
        self._out(self.filter.release(until_ns))
        return self

    def _out(self, messages: list[Message]) -> None:
        for sent in messages:
            assert isinstance(sent, CaptureState)
            self.sent.append(sent.request_id)


def test_an_omitted_message_is_not_sent() -> None:
    channel = Channel().add(Disturbance.OMISSION, nth=2).send(1, 2, 3)
    assert channel.sent == [1, 3] and channel.notes == [(7, ALTERED, 2)] and channel.filter.over


def test_a_duplicate_is_sent_twice() -> None:
    channel = Channel().add(Disturbance.DUPLICATE, nth=2).send(1, 2, 3)
    assert channel.sent == [1, 2, 2, 3] and channel.notes == [(7, ALTERED, 2)] and channel.filter.over


def test_a_delayed_message_comes_in_its_time_and_what_is_behind_it_too() -> None:
    channel = Channel().add(Disturbance.DELAY, nth=2).send(1, 2).send(3, at_ns=4)
    assert channel.sent == [1] and channel.filter.due_ns() == BY_NS and not channel.filter.over
    assert channel.wait(BY_NS - 1).sent == [1]
    assert channel.wait(BY_NS).sent == [1, 2, 3] and channel.filter.over
    assert channel.notes == [(7, HELD, 2), (7, ALTERED, 2)], "of what merely waited there is nothing to say"


def test_a_message_that_comes_behind_the_time_sends_what_was_due() -> None:
    assert Channel().add(Disturbance.DELAY).send(1).send(2, at_ns=BY_NS).sent == [1, 2]


def test_a_lasting_delay_is_as_long_for_each() -> None:
    channel = Channel().add(Disturbance.DELAY, persistence=Permanent()).send(1).send(2, at_ns=4)
    assert channel.wait(BY_NS).sent == [1] and channel.filter.due_ns() == BY_NS + 4
    assert channel.wait(BY_NS + 4).sent == [1, 2]


def test_a_successor_goes_ahead() -> None:
    channel = Channel().add(Disturbance.REORDER, nth=2).send(1, 2, 3, 4)
    assert channel.sent == [1, 3, 2, 4] and channel.notes == [(7, HELD, 2), (7, ALTERED, 2)]


def test_without_a_successor_it_is_late_and_nothing_has_changed_places() -> None:
    channel = Channel().add(Disturbance.REORDER).send(1)
    assert channel.wait(BY_NS).sent == [1] and channel.notes == [(7, HELD, 1)] and channel.filter.over


def test_two_faults_of_one_channel_stand_one_behind_the_other() -> None:
    channel = (
        Channel().add(Disturbance.DUPLICATE, fault=7).add(Disturbance.OMISSION, nth=2, fault=8).send(1, 2)
    )
    assert channel.sent == [1, 2] and channel.notes == [(7, ALTERED, 1), (8, ALTERED, 1)]


def test_what_is_stopped_strikes_no_more_and_gives_back_what_it_has() -> None:
    channel = Channel().add(Disturbance.DELAY, persistence=Permanent()).send(1)
    channel.filter.stop(7)
    assert channel.send(2).wait(BY_NS).sent == [1, 2] and channel.filter.over
    channel.filter.stop(9)  # there is none


hows = st.tuples(
    st.sampled_from(Disturbance), st.integers(1, 5), st.sampled_from((ONCE, Permanent(), Every(3)))
)


@given(st.lists(hows, max_size=4), st.lists(st.integers(0, 30), max_size=30))
def test_nothing_is_made_up_and_nothing_is_kept(
    faults: list[tuple[Disturbance, int, Persistence]], steps_ns: list[int]
) -> None:
    channel, now_ns = Channel(), 0
    for fault, (how, nth, persistence) in enumerate(faults):
        channel.add(how, nth, persistence, fault)
    for number, step_ns in enumerate(steps_ns):
        now_ns += step_ns
        channel.wait(now_ns).send(number, at_ns=now_ns)
    channel._out(channel.filter.flush(now_ns))
    assert channel.filter.due_ns() is None
    kinds = {how for how, _, _ in faults}
    lost = set(range(len(steps_ns))) - set(channel.sent)
    assert set(channel.sent) <= set(range(len(steps_ns)))
    assert not lost or Disturbance.OMISSION in kinds
    assert len(channel.sent) == len(set(channel.sent)) or Disturbance.DUPLICATE in kinds
    assert channel.sent == sorted(channel.sent) or Disturbance.REORDER in kinds
