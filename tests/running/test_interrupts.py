"""Ctrl-C while threads are started."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from carlasc.errors import postponed_interrupts

PROGRAM = """
import os, signal, threading
from carlasc.storage.packed.chunks import in_threads

start = threading.Thread.start

def start_and_interrupt(thread):
    start(thread)
    os.kill(os.getpid(), signal.SIGINT)

threading.Thread.start = start_and_interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    in_threads(str, range(3))
except KeyboardInterrupt:
    print("interrupted")
"""


def test_ctrl_c_waits_for_the_end_of_the_block():
    before, reached = signal.signal(signal.SIGINT, signal.default_int_handler), []
    try:
        with pytest.raises(KeyboardInterrupt), postponed_interrupts():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            reached.append(True)
        assert reached == [True]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_other_threads_are_left_alone():
    handlers = []

    def look():
        with postponed_interrupts():
            handlers.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=look)
    thread.start()
    thread.join()
    assert handlers == [signal.getsignal(signal.SIGINT)]


def test_a_program_that_is_interrupted_while_its_threads_start_ends():
    ran = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, timeout=60, check=False, start_new_session=True
    )
    assert (ran.returncode, ran.stdout) == (0, "interrupted\n"), ran.stderr
