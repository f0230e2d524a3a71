"""What tests of detection share."""

import pytest

from velfield.detection.cnn.quantization import is_exact


@pytest.fixture
def exact() -> None:
    """Skips a test of 8 bits where the processor has none that are right."""
    if not is_exact():
        pytest.skip("this processor saturates sums of products of 8 bits")
