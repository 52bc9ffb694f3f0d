"""`aftbed web`: the page of a live run, to watch and to steer it."""

import sys
import webbrowser
from typing import Annotated

import typer

from aftbed.cli.options import Json, Run, check_range, print_json
from aftbed.report import live_page
from aftbed.runtime.unix import run_directory
from aftbed.runtime.unix.launch import listen_on_loopback

Port = Annotated[int, typer.Option(help="TCP port of the page on 127.0.0.1; 0 is any free one.")]
Open = Annotated[bool, typer.Option("--open", help="Open the page in the browser.")]


def web(run: Run = None, port: Port = 0, open_it: Open = False, json: Json = False) -> None:
    """The page of a live run in a browser, to watch and to steer it.

    It is served on 127.0.0.1 until the run ends, to this user alone.
    """
    check_range("--port", port, 0, 65535)
    private = run_directory.find(run)
    listener, token = listen_on_loopback(port, "--port"), live_page.new_token()
    shown = live_page.address(listener, token)
    if json:
        print_json({"run": private.name, "page": shown})
        sys.stdout.flush()  # a reader waits for it: the command ends with the run
    else:
        print(f"run {private.name}: {shown}", flush=True)
    if open_it:
        webbrowser.open(shown)
    live_page.serve(listener, private, token)
    if not json:
        print(f"run {private.name} has ended")
