"""`--requests`, `--count` and `--expect`: requests of the user, for real and for simulated runs."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from aftbed.cli.options import check_range
from aftbed.core.errors import ConfigError
from aftbed.functions.load import OWN_CODE
from aftbed.functions.request_file import (
    REQUESTS_MAX,
    ExpectedReplies,
    GivenRequests,
    generated,
    located_requests,
    names_function,
    read_replies,
    read_requests,
)
from aftbed.functions.source import is_foreign
from aftbed.vehicle.aeb.function import sample_requests

TRIED_OUT_MAX: Final = 16


def first_requests(application: str, given: GivenRequests | None) -> tuple[bytes, ...]:
    """A few of a run, with which a function is tried out; `given` is None where they are those of a car."""
    if given is not None:
        return given.requests[:TRIED_OUT_MAX]
    return tuple(sample_requests(0, TRIED_OUT_MAX, fixed=is_foreign(application)))


class RequestSource:
    """Where the requests of a run come from. Files are read at once; a function is called for each seed."""

    def __init__(
        self, source: str, *, count: int | None, count_max: int, expect: str | None, tolerance: float | None
    ) -> None:
        """Raises ConfigError, also where there are not as many expected replies as requests."""
        self._expect, self._tolerance = expect, tolerance
        self.name = located_requests(source)
        if names_function(source):
            if count is None:
                raise ConfigError(
                    f"--requests {source}: a function makes as many as are asked for: give --count"
                )
            check_range("--count", count, 1, min(count_max, REQUESTS_MAX))
            self.count = count
            self._requests: Callable[[int], tuple[bytes, ...]] = self._generated
        else:
            requests = read_requests(Path(source)).requests
            self.count = len(requests) if count is None else count
            check_range("--count", self.count, 1, count_max)
            self._requests = lambda seed: requests
        self._expected = self._read_expected(asked=count is not None)

    def _generated(self, seed: int) -> tuple[bytes, ...]:
        return tuple(generated(self.name, self.count, seed, OWN_CODE))

    def _read_expected(self, *, asked: bool) -> ExpectedReplies | None:
        """Replies of requests that are not sent are left over only where `--count` asks for fewer."""
        if self._expect is None:
            if self._tolerance is not None:
                raise ConfigError("--tolerance is about --expect: give it too")
            return None
        found = read_replies(Path(self._expect), self._tolerance)
        replies = len(found.replies)
        if replies < self.count or (replies > self.count and not asked):
            raise ConfigError(
                f"--expect {self._expect}: {replies} replies, and {self.count} requests are sent; as many are"
                " required"
            )
        return found

    def of(self, seed: int) -> GivenRequests:
        """For a run of this seed. Raises ConfigError where its function fails."""
        expect = str(Path(self._expect).resolve()) if self._expect is not None else ""
        return GivenRequests(self.name, self._requests(seed), expect, self._expected, self._tolerance)
