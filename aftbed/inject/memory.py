"""A bit flip of a process's own memory, wherever it is: the heap or anonymous memory, code and records
included.

    bitflip memory [bit K] [address 0x...] [in TARGET] [at EVENT [nth N] | after 200ms | when ttc < 1.2]

What is not named is drawn from what the process can write. The consequence can be anything, so it proves
nothing about a mechanism alone: the user has to agree to it (`--unsafe-memory`). There is no undo: the bit
is lost with the process. How the memory of another process is reached is in `runtime.unix.process_memory`.
"""

import re
from collections.abc import Iterable, Sequence
from typing import Final, Self

from aftbed.core.errors import ConfigError, StepFailed
from aftbed.core.graph import Graph
from aftbed.inject import targets
from aftbed.inject.grammar import BYTE_BITS, PATTERN_KEYS, REPEAT_KEYS, FaultWords, whole
from aftbed.inject.kind import AnyFault, FaultKind, Injection, RunControl, Steps, strike
from aftbed.inject.receipts import Receipt, ReceiptState
from aftbed.inject.value import BITFLIP, BITFLIP_KEYS, MEMORY

_ADDRESS: Final = re.compile(r"0x[0-9a-fA-F]{1,12}")


class MemoryFlip(FaultKind, frozen=True, tag="memory"):
    """Bit `bit` of the byte at `address` is flipped; what is None is drawn."""

    bit: int | None = None
    address: int | None = None

    NAMES = (BITFLIP,)
    KEYS = BITFLIP_KEYS
    REFUSED = tuple(key for key in (*PATTERN_KEYS, *REPEAT_KEYS) if key != "bit")

    alters_value = True
    strikes_stored_state = True
    unsafe = True
    simulated = False

    @classmethod
    def claims(cls, words: Sequence[str]) -> bool:
        return super().claims(words) and words[1] == MEMORY

    @classmethod
    def from_words(cls, words: FaultWords) -> Self:
        other = words.first_of(cls.REFUSED)
        if other is not None:
            raise ConfigError(f"{other!r}: of memory one bit is flipped, once: 'bit 0' to 'bit 7' of a byte")
        bit = whole("bit", words["bit"], 0, BYTE_BITS - 1) if "bit" in words else None
        return cls(bit, _address(words["address"]) if "address" in words else None)

    @classmethod
    def subjects(cls, graph: Graph) -> tuple[str, ...]:
        return (MEMORY,)

    @classmethod
    def next_words(cls, words: Sequence[str], graph: Graph) -> Iterable[str]:
        if words[-1] == "in":
            return (*targets.roles_in(graph), *graph.nodes)
        return super().next_words(words, graph)

    def subject(self, target: str) -> list[str]:
        bit = "" if self.bit is None else f"bit {self.bit}"
        address = "" if self.address is None else f"address {self.address:#x}"
        return [MEMORY, bit, address, "in", target]

    def check(self, fault: AnyFault, graph: Graph) -> None:
        """Nodes only: what the command itself or the hub keeps is not the system under test."""
        targets.check_node(fault.target, fault.event, graph)

    def act(self, injection: Injection, run: RunControl) -> Steps[None]:
        """Flip it in one of the target's nodes."""
        processes = sorted(strike(injection, run), key=lambda p: p.name)
        if processes:
            process = processes[injection.draw % len(processes)]
            try:
                which = run.flip_memory(process, self.bit, self.address, injection.draw)
                injection.receipt = Receipt(ReceiptState.APPLIED, which)
            except StepFailed as failure:
                injection.receipt = Receipt(ReceiptState.INJECT_ERROR, str(failure))
            run.log(injection)
        yield from ()


def _address(text: str) -> int:
    if not _ADDRESS.fullmatch(text):
        raise ConfigError(f"address {text[:40]!r}: a hexadecimal number is allowed, as 0x7f0012345678")
    return int(text, 16)


def refuse_unsafe(what: str, *, agreed: bool, option: str = "--unsafe-memory") -> None:
    """Raise ConfigError where the user has not agreed, by `option`, to a fault that may do anything."""
    if not agreed:
        raise ConfigError(
            f"{what}: it flips a bit of whatever a process keeps there, the testbed's own code and records"
            f" included, so what comes of it proves nothing about a mechanism alone; say {option} if that is"
            " wanted"
        )
