"""A brick in memory with its ends of channels, the channels, and how a message is written down."""

from collections import deque
from typing import NamedTuple

from aftbed.core.brick import Brick, Effect
from aftbed.core.graph import Link
from aftbed.core.message import Message, Suspect, TakeOver, Trial, Trials


class Channel:
    """`mail` in its order, each with the number of its sending; `ended`: nothing more will come."""

    def __init__(self, link: Link) -> None:
        self.link = link
        self.mail: deque[tuple[int, Message]] = deque()
        self.ended = False


class Host:
    """One brick with its effects still to be performed, and its ends of channels."""

    def __init__(self, name: str, brick: Brick, journal: str) -> None:
        self.name, self.brick, self.journal = name, brick, journal
        self.todo: deque[Effect] = deque()
        self.inputs: dict[str, Channel] = {}
        self.outputs: dict[str, Channel] = {}
        self.suspended = False

    def takes(self, port: str) -> bool:
        """Whether mail there is read now; who is suspended finishes what is inside."""
        return port in self.brick.open_ports() and not (self.suspended and self.brick.quiescent())


class Sent(NamedTuple):
    """One message that was put into a channel."""

    link: str
    message: Message

    def __str__(self) -> str:
        match self.message:
            case Suspect(node=node, cause=cause):
                about = f"{node} {cause}"
            case TakeOver(epoch=epoch):
                about = f"epoch={epoch}"
            case Trial(request_id=number, rerun=True):
                about = f"{number} rerun"
            case Trials(request_id=number, tried=tried):
                about = f"{number} x{len(tried)}"
            case message:
                about = str(message.request_id)  # type: ignore[attr-defined]
        return f"{self.link} {type(self.message).__name__}({about})"
