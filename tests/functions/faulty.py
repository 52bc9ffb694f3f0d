"""A program that answers as its arguments say: its description, then what it does when it is to execute.

Its state is the number of requests. `@` stands for the id of the request.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

describes, does = sys.argv[1:]
count = 0


def answer(line: str) -> None:
    sys.stdout.write(line)
    sys.stdout.flush()


def stderr(text: str) -> None:
    sys.stderr.write(text)
    sys.stderr.flush()


for line in sys.stdin:
    request = json.loads(line)
    number = str(request["id"])
    if "describe" in request:
        answer(describes.replace("@", number) + "\n")
    elif "capture" in request:
        answer(f'{{"id":{number},"capture":"{count:08x}"}}\n')
    elif "restore" in request:
        answer(f'{{"id":{number},"restore":null}}\n')
    elif "acceptable" in request:
        found = request["acceptable"]
        answer(
            json.dumps({"id": int(number), "acceptable": found["reply"] == "01" + found["request"]}) + "\n"
        )
    elif does == "exit":
        stderr("out of brakes\x1b[2J\n")
        sys.exit(3)
    elif does == "die in the middle":
        answer('{"id":')
        os.kill(os.getpid(), signal.SIGKILL)
    elif does == "close":
        os.close(1)
        time.sleep(1000)
    elif does == "sleep":
        time.sleep(1000)
    elif does == "drip":
        while True:
            answer(" ")
    elif does == "flood":
        while True:
            answer("x" * 4096)
    elif does == "noise":
        stderr("x" * 200_000)  # a pipe holds 64 kB
        answer(f'{{"id":{number},"execute":""}}\n')
        stderr("x" * 200_000)
    elif does == "noise and exit":
        stderr("x" * 1_000_000 + "the last line")
        sys.exit(3)
    elif does == "noise and no answer":
        stderr("x" * 1_000_000 + "the last line")
        time.sleep(1000)
    elif does == "noise without end":
        while True:
            stderr("x" * 4096)
    elif does == "no stderr":
        os.close(2)
        answer(f'{{"id":{number},"execute":""}}\n')
    elif does == "late":
        answer(f'{{"id":{number},"execute":"01"}}\n{{"id":{number},"execute":"02"}}\n')
    elif does == "descriptors":
        count += 1
        links = {one.name: one for one in Path("/proc/self/fd").iterdir()}
        found = sorted(f"{n} {link.readlink().name[:4]}" for n, link in links.items() if link.is_symlink())
        answer(json.dumps({"id": int(number), "execute": "\n".join(found).encode().hex()}) + "\n")
    else:
        count += 1
        answer(does.replace("@", number) + "\n")
