"""Variants of the protected function that differ from it in one thing each: what an app update may bring.

| variant              | differs in   | so that                                                            |
|----------------------|--------------|--------------------------------------------------------------------|
| `WithoutStateAccess` | state access | PBR's backup never has the state; TR cannot go back to it          |
| `NonDeterministic`   | determinism  | TR's executions differ without a fault; LFR's replicas diverge     |
| `Cautious`           | decisions    | nothing breaks: version 2 warns earlier; its state is another form |

Each wraps the function and declares its `characteristics`, so that an unsuitable mechanism is refused
beforehand; forced all the same, it fails as in the table above. Named as
`aftbed.vehicle.aeb.variants:Cautious`.
"""

from random import SystemRandom
from typing import Final

import msgspec

from aftbed.core.application import NONE, Application, Characteristics, Field
from aftbed.core.errors import PeerError
from aftbed.vehicle.aeb.function import STATE_BYTES, AebFunction, default_application
from aftbed.vehicle.aeb.messages import STAGE_NONE, STAGE_WARN, decode_reply, encode_reply

NOISE_PART: Final = 0.01  # of the time to collision; the radar's own noise is more
EARLY_TTC_S: Final = 3.5  # version 1 warns at 2.7 s
CALM_TTC_S: Final = 4.0  # an early warning ends here
CAUTIOUS_VERSION: Final = 2
CAUTIOUS_BYTES: Final = 2 + STATE_BYTES  # version, whether it warns early, version 1's state


class WithoutStateAccess:
    """The function with its state locked in, like that of a supplier that gives no access."""

    characteristics = Characteristics(state_access=NONE)

    def __init__(self) -> None:
        self._function: Application = default_application()

    def execute(self, request: bytes) -> bytes:
        return self._function.execute(request)

    def capture(self) -> bytes:
        return b""

    def restore(self, state: bytes) -> None:
        """Accepts only the empty state that `capture` gives, and changes nothing. Raises PeerError."""
        if state:
            raise PeerError(f"state of {len(state)} bytes, expected none: there is no access to it")

    def migrate(self, old_state: bytes) -> None:
        """Begin where the open version ended. Raises PeerError."""
        self._function.restore(old_state)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return self._function.acceptable(request, reply)


class NonDeterministic:
    """The function with a random error of up to one part in a hundred in its time to collision.

    Each reply is acceptable, and hardly two are equal, as of a function that reads its own clock.
    """

    characteristics = Characteristics(deterministic=False)
    fields = AebFunction.fields

    def __init__(self) -> None:
        self._function: Application = default_application()
        self._random = SystemRandom()  # another one would be the same in every fork of a zygote

    def execute(self, request: bytes) -> bytes:
        reply = self._function.execute(request)
        output = decode_reply(reply)
        if output.ttc_s is None:
            return reply
        noise = self._random.uniform(-NOISE_PART, NOISE_PART)
        other = encode_reply(msgspec.structs.replace(output, ttc_s=output.ttc_s * (1.0 + noise)))
        return other if self._function.acceptable(request, other) else reply

    def capture(self) -> bytes:
        return self._function.capture()

    def restore(self, state: bytes) -> None:
        self._function.restore(state)

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return self._function.acceptable(request, reply)


class Cautious:
    """Version 2: warns from `EARLY_TTC_S` on, and brakes as version 1 does.

    Its state is version 1's behind two bytes, so that neither is valid for the other; `migrate` converts it.
    """

    characteristics = Characteristics()
    fields: tuple[Field, ...] = (
        Field("warns", "u8", 1),
        *(Field(field.name, field.kind, 2 + field.offset_bytes) for field in AebFunction.fields),
    )

    def __init__(self) -> None:
        self._function: Application = default_application()
        self._warns = False

    def execute(self, request: bytes) -> bytes:
        """Raises PeerError, with nothing changed."""
        reply = self._function.execute(request)
        output = decode_reply(reply)
        limit_s = CALM_TTC_S if self._warns else EARLY_TTC_S
        self._warns = output.ttc_s is not None and output.ttc_s <= limit_s
        if output.stage != STAGE_NONE or not self._warns:
            return reply
        return encode_reply(msgspec.structs.replace(output, stage=STAGE_WARN))

    def capture(self) -> bytes:
        return bytes((CAUTIOUS_VERSION, self._warns)) + self._function.capture()

    def restore(self, state: bytes) -> None:
        """Raises PeerError, with nothing changed, if `state` is not one."""
        if len(state) != CAUTIOUS_BYTES:
            raise PeerError(f"state of {len(state)} bytes, expected {CAUTIOUS_BYTES}")
        version, warns, function = state[0], state[1], state[2:]
        if version != CAUTIOUS_VERSION:
            raise PeerError(f"state of version {version}, expected {CAUTIOUS_VERSION}")
        if warns > 1:
            raise PeerError(f"state with an early warning of {warns}, allowed is 0 or 1")
        self._function.restore(function)
        self._warns = bool(warns)

    def migrate(self, old_state: bytes) -> None:
        """Begin where version 1 ended. Raises PeerError, with nothing changed, on another state."""
        self._function.restore(old_state)
        self._warns = False

    def acceptable(self, request: bytes, reply: bytes) -> bool:
        return self._function.acceptable(request, reply)
