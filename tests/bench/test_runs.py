"""What the benches share: interpreters that fail or do not end."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from homes import Home
from liveruns import WAIT_SECONDS_MAX, ended, readable

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


@pytest.mark.process
def test_an_interpreter_dies_with_the_bench(home: Home, tmp_path: Path) -> None:
    """Whatever kills the bench."""
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    reader = os.open(fifo, os.O_RDONLY | os.O_NONBLOCK)
    inner = f"import os, select; open({str(fifo)!r}, 'w').write(str(os.getpid())); select.select([], [], [])"
    outer = f"from aftbed.bench.runs import run_python; run_python(['-c', {inner!r}], 60.0)"
    with subprocess.Popen([sys.executable, "-c", outer]) as bench:
        assert readable(reader, WAIT_SECONDS_MAX)
        pid = int(os.read(reader, 100))
        bench.kill()
    os.close(reader)
    assert ended(pid)
