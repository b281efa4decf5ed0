"""What all tests share: one thread a process, so that runs in parallel stay quick."""

import pytest


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> None:
    import torch

    torch.set_num_threads(1)
