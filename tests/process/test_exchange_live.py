"""The function of a live run is exchanged: for another kind, for new content of its file, for bad ones."""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import psutil
import pytest
from liveruns import Command, adapted, aftbed, home, until

from aftbed.functions.library import HEADER
from aftbed.runtime.unix import control_client, run_directory

pytestmark = pytest.mark.process

__all__ = ["home"]

LIBRARY: Final = """
#include <stdlib.h>
#include <string.h>
#include "aft.h"
int aft_init(void **instance) { *instance = calloc(1, 4); return AFT_OK; }
int aft_execute(void *instance, const uint8_t *request, size_t request_size, uint8_t *reply, size_t reply_max,
                size_t *reply_size) {
    *(uint32_t *)instance += request_size * STEP;
    memcpy(reply, instance, *reply_size = 4);
    return AFT_OK;
}
int64_t aft_state_size(void *instance) { return 4; }
int aft_capture(void *instance, uint8_t *state, size_t size) { memcpy(state, instance, size); return AFT_OK; }
int aft_restore(void *instance, const uint8_t *state, size_t size) {
    if (size != 4) return AFT_REFUSED;
    if (CRASHES) abort();
    memcpy(instance, state, size);
    return AFT_OK;
}
"""
PROGRAM: Final = """
import json, sys
total = executed = 0
for line in sys.stdin:
    asked = json.loads(line)
    answer = {"id": asked["id"]}
    if "describe" in asked:
        answer["describe"] = {}
    elif "execute" in asked:
        executed, total = executed + 1, total + len(asked["execute"]) // 2 * STEP
        answer["execute"] = total.to_bytes(4, "little").hex()
    elif "capture" in asked:
        answer["capture"] = total.to_bytes(4, "little").hex()
    else:
        RESTORING
        total, answer["restore"] = int.from_bytes(bytes.fromhex(asked["restore"]), "little"), None
    print(json.dumps(answer), flush=True)
"""


def program(path: Path, step: int, restoring: str = "pass") -> str:
    """The command line of the program in that file, which is written anew."""
    path.write_text(PROGRAM.replace("STEP", str(step)).replace("RESTORING", restoring))
    return shlex.join([sys.executable, "-I", "-S", str(path)])


def library(path: Path, step: int, *options: str) -> str:
    compiler = next((one for one in ("cc", "gcc", "clang") if shutil.which(one)), None)
    if compiler is None:
        pytest.skip("there is no compiler")
    path.with_suffix(".c").write_text(LIBRARY)
    words = [compiler, "-shared", "-fPIC", f"-DSTEP={step}", "-I", HEADER.parent]
    subprocess.run(
        [*words, *(options or ["-DCRASHES=0"]), "-o", path, path.with_suffix(".c")], check=True, timeout=60
    )
    return str(path)


def update(source: str, code: int) -> str:
    """What the command says that exchanges the function for `source`, which ends with `code`."""
    done = adapted("update", "app", "--to", source, "--may-fail")
    assert done.code == code, done.out + done.err
    return done.out + done.err


def crash() -> None:
    """The primary is killed, and a new backup stands."""
    private = run_directory.root() / run_directory.live()[0]

    def redundant() -> object:
        status = control_client.ask(private, control_client.StatusQuery())
        return status["epoch"] if status["backup"] and not status["busy"] else 0

    before = until(redundant, "redundancy")
    assert aftbed("inject", "crash", "primary").code == 0
    until(lambda: redundant() not in (0, before), "a new backup")


def test_the_function_is_exchanged_while_it_serves_and_bad_ones_are_not_taken(tmp_path: Path) -> None:
    """Nothing is lost or wrong meanwhile: each version is executed again for its own requests."""
    mine, other = tmp_path / "mine.py", tmp_path / "other.py"
    app = program(mine, 1)
    with Command("--app", app, "--load", "100000@200") as run:
        run.wait_for_line("roles: a leads, b backs up")
        assert "with the same content: nothing was changed" in update(app, 2)
        program(mine, 2)
        crash()  # until the update, a new backup is what the run began with: it leads after the second crash
        crash()
        assert ": done" in update(app, 0)
        assert "@sha256:" in update(app, 2)
        crash()
        less = library(tmp_path / "less.so", 1, "-DCRASHES=0", "-Daft_capture=capture")
        assert "lacks aft_capture (required by aft.h)" in update(less, 2)
        assert "ended with exit code 0, asked to describe" in update(f"{sys.executable} -I -c 0", 2)
        died = update(library(tmp_path / "crashing.so", 1, "-DCRASHES=1"), 2)
        assert f"a/server' died while it loaded and tried {tmp_path}/crashing.so" in died.replace("b/", "a/")
        late = program(other, 3, "assert executed, 'not now'")  # not in the self-test, which executes first
        assert f"rolled back: {late} takes no state of {app}@sha256:" in update(late, 1)
        assert ": done" in update(library(tmp_path / "mine.so", 3), 0)
        library(tmp_path / "mine.so", 4)
        assert ": done" in update(str(tmp_path / "mine.so"), 0)
        crash()
        assert aftbed("stop").code == 0
        done = run.done()
    assert done.code == 0 and "verdict: pass" in done.out, done.out + done.err
    assert " 0 lost, 0 duplicated, " in done.out and " 0 wrong" in done.out
    running = [one.info["cmdline"] for one in psutil.process_iter(["cmdline"])]
    assert not [words for words in running if words and str(tmp_path) in " ".join(words)]
