"""Fixtures of several test files."""

import pytest


@pytest.fixture
def one_thread():
    """As in a run: two threads on networks this small wait for each other, on busy cores for minutes."""
    from baselines.training.runs import one_thread

    with one_thread():
        yield
