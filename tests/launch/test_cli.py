"""The command line as a whole."""

import os
import subprocess
import sys


def test_end_does_not_wait_for_callbacks() -> None:
    """Zenoh's threads outlive a session; an interpreter that ends under them hangs or aborts."""
    program = """
import sys, threading, click, zenoh
from udrl_launch import cli
from udrl_proto.session import listen
from udrl_launch.training import free_port

@click.command()
def busy():
    called = threading.Event()

    def callback(sample):
        called.set()
        while True:
            pass

    with listen(f"tcp/127.0.0.1:{free_port()}") as session:
        session.declare_subscriber("key", callback)
        session.put("key", b"")
        assert called.wait(10)
    print("worked")
    return 3

cli.cli.add_command(busy)
sys.argv = ["udrl", "busy"]
cli.main()
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, timeout=30)
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, b"worked\n", b"")


def test_numpy_computes_in_one_thread() -> None:
    """Its threads spin while they wait: two actors on two cores made a fifth of the steps."""
    program = """
import os, sys, click
from udrl_launch import cli

@click.command()
def count():
    import numpy as np
    np.ones((500, 500)) @ np.ones((500, 500))
    print(len(os.listdir("/proc/self/task")))

cli.cli.add_command(count)
sys.argv = ["udrl", "count"]
cli.main()
"""
    unset = {name: value for name, value in os.environ.items() if "NUM_THREADS" not in name}
    ended = subprocess.run(
        [sys.executable, "-c", program], env=unset, capture_output=True, timeout=30
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, b"1\n", b"")
