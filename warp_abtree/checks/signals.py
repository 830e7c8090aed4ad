"""SIGINT and SIGTERM of a command."""

import os
import signal
import threading

IMPORTS = "<frozen importlib._bootstrap>"  # the code that runs while a module is imported
DELAY = 0.01  # seconds after which a signal comes again
_deferred = []  # the signal that comes again


def not_swallowed(handler):
    """Return a handler that lets a signal come again until no import and no `__del__` runs: these swallow errors."""

    def handle(number, frame):
        caller = frame
        while caller is not None:
            if caller.f_code.co_filename == IMPORTS or caller.f_code.co_name == "__del__":
                _deferred[:] = [number]
                again = threading.Timer(DELAY, send, [number])
                again.daemon = True
                again.start()
                return
            caller = caller.f_back
        _deferred.clear()
        handler(number, frame)

    return handle


def send(number):
    """Send a signal to this process."""
    if os.name == "nt":
        signal.raise_signal(number)
    else:
        os.kill(os.getpid(), number)


def handle_signals(interrupt, terminate):
    """Let SIGINT and SIGTERM call handlers, although the process may have inherited that they are ignored.

    Shells start background jobs with SIGINT ignored. A signal that the handlers before deferred goes to these.
    """
    if threading.current_thread() is not threading.main_thread():
        return  # only the main thread may, and receives signals
    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, terminate)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    if _deferred:
        send(_deferred.pop())
