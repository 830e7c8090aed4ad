"""SIGINT and SIGTERM of a command."""

import signal
import threading


def handle_signals(interrupt, terminate):
    """Let SIGINT and SIGTERM call handlers, although the process may have inherited that they are ignored.

    Shells start background jobs with SIGINT ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        return  # only the main thread may, and receives signals
    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, terminate)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
