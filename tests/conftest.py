"""Fixtures that every test may use."""

from collections.abc import Callable
from pathlib import Path

import pytest

FOOTAGE = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def footage() -> Callable[[str], Path]:
    """Path of one folder of the real footage; skips the test, saying so, where it is absent."""

    def find(name: str) -> Path:
        path = FOOTAGE / name
        if not path.exists():
            pytest.skip(f"the real footage {name!r} is not there ({path})")
        return path

    return find
