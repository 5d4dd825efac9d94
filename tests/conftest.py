"""Tests hear Ctrl-C, however they were begun.

A shell without job control lets what it begins in the background ignore the signal, and
every process that a test begins would inherit that.
"""

import signal

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
