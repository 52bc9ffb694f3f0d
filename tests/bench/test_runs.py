"""What the benches share: interpreters that fail or do not end."""

import pytest

from aftbed.bench.runs import run_python
from aftbed.core.errors import HarnessError


def test_an_interpreter_that_fails_is_named_with_its_last_words() -> None:
    with pytest.raises(HarnessError, match=r"python -c .*: exit code 3: no room") as caught:
        run_python(["-c", "import sys; sys.stderr.write('no room'); sys.exit(3)"], 20.0)
    assert "Traceback" not in str(caught.value)


def test_an_interpreter_that_does_not_end_is_ended() -> None:
    with pytest.raises(HarnessError, match=r"python -c .*: not ended after 0.2 s"):
        run_python(["-c", "import select; select.select([], [], [])"], 0.2)


def test_what_an_interpreter_prints_is_returned() -> None:
    assert run_python(["-c", "print('12')"], 20.0) == b"12\n"
