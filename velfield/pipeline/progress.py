"""Progress of long work: kernels' callers say how far they are, whoever listens in the same process shows it.

On a worker of a cluster nobody listens, and saying so costs nothing; there progress is seen unit by unit.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

Listener = Callable[[str, int], None]

_listeners: list[Listener] = []


def advance(stage: str, steps: int = 1) -> None:
    """Say that ``steps`` more steps (frames, mostly) of ``stage`` are done."""
    for listener in tuple(_listeners):
        listener(stage, steps)


@contextmanager
def listening(listener: Listener) -> Iterator[None]:
    """Hear of all progress made in this process within the context.

    Examples
    --------
    >>> heard = []
    >>> with listening(lambda stage, steps: heard.append((stage, steps))):
    ...     advance("detections", 8)
    >>> heard
    [('detections', 8)]
    """
    _listeners.append(listener)
    try:
        yield
    finally:
        _listeners.remove(listener)
