"""Progress within a unit: stages publish their steps, subscribers in the same process show them.

On a worker of a cluster there is no subscriber, and publishing costs nothing; there progress is shown unit by unit.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Listener = Callable[[str, int], None]

_listeners: list[Listener] = []


def advance(stage: str, steps: int = 1) -> None:
    """Publish that ``steps`` more steps (frames, mostly) of ``stage`` are done."""
    for listener in tuple(_listeners):
        listener(stage, steps)


@contextmanager
def subscribe(listener: Listener) -> Iterator[None]:
    """Call ``listener`` with all progress of this process within the context.

    Examples
    --------
    >>> received = []
    >>> with subscribe(lambda stage, steps: received.append((stage, steps))):
    ...     advance("detections", 8)
    >>> received
    [('detections', 8)]
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)
