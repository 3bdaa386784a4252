"""Ctrl-C and SIGTERM: the first asks to stop at the next safe point, a second Ctrl-C ends the process at once."""

import contextlib
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

_DONE = b"\0"  # no signal has the number 0


class Stop:
    """Whether a signal has arrived. Calling it returns the number of the first, or None."""

    number: int | None = None

    def __call__(self) -> int | None:
        return self.number


@contextmanager
def stopping() -> Iterator[Stop]:
    """While open, SIGINT and SIGTERM set the returned Stop; the former handlers are restored afterwards.

    Outside of the main thread signals cannot be handled, and a signal that is ignored (nohup) stays ignored.
    """
    stop = Stop()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handled = [number for number, handler in former.items() if handler not in (signal.SIG_IGN, None)]

    def arrived(number: int, frame: FrameType | None) -> None:
        if stop.number is None:
            stop.number = number

    def restore() -> None:
        for number in handled:
            signal.signal(number, former[number])

    def restore_in_child() -> None:
        restore()
        if former[signal.SIGINT] is signal.default_int_handler:
            # A KeyboardInterrupt that comes while the process is still being forked would be swallowed: a worker simply ends.
            signal.signal(signal.SIGINT, signal.SIG_DFL)

    with _watching(), _undone_in_children(restore_in_child):
        for number in handled:
            signal.signal(number, arrived)
        try:
            yield stop
        finally:
            restore()


@contextmanager
def _watching() -> Iterator[None]:
    """A thread that reads the bytes which the C handler writes ends the process at the second Ctrl-C: Python runs its own handlers between two bytecodes
    of the main thread, never while that is inside a long foreign call."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    former = signal.set_wakeup_fd(writing, warn_on_full_buffer=False)

    def watch() -> None:
        presses = 0
        while (received := os.read(reading, 1)) != _DONE:
            if former >= 0:
                with contextlib.suppress(OSError):
                    os.write(former, received)
            presses += received[0] == signal.SIGINT
            if presses > 1:
                os._exit(128 + signal.SIGINT)

    thread = threading.Thread(target=watch, name="second Ctrl-C", daemon=True)
    thread.start()
    try:
        with _undone_in_children(lambda: signal.set_wakeup_fd(former)):
            yield
    finally:
        signal.set_wakeup_fd(former)
        os.write(writing, _DONE)  # closing would not do: a forked child may hold the pipe open
        thread.join()
        os.close(writing)
        os.close(reading)


# Worker processes that a stage forks must die of SIGTERM as usual, and the Ctrl-C that a terminal sends to all of them counts once. Signals
# wait while a process is forked: one that came before the child has its own handlers back would be lost.
_in_children: list[Callable[[], object]] = []
_masks = threading.local()


def _before_fork() -> None:
    waiting = {signal.SIGINT, signal.SIGTERM} if _in_children else set()
    _masks.former = signal.pthread_sigmask(signal.SIG_BLOCK, waiting)


def _after_fork() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _masks.former)


def _in_child() -> None:
    for undo in reversed(_in_children):
        undo()
    _in_children.clear()
    _after_fork()


os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_in_child)


@contextmanager
def _undone_in_children(undo: Callable[[], object]) -> Iterator[None]:
    _in_children.append(undo)
    try:
        yield
    finally:
        if undo in _in_children:
            _in_children.remove(undo)
