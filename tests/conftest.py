"""Tests hear Ctrl-C, however they were begun, and files with slow tests come first.

A shell without job control lets what it begins in the background ignore the signal, and
every process that a test begins would inherit that.
"""

import signal

import pytest

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """With files on several processors none is busy long after the others."""
    slow = {one.path for one in items if one.get_closest_marker("slow")}
    items.sort(key=lambda one: one.path not in slow)
