"""A tiny random SmolVLM, for ``smolvla`` without a download."""

from pathlib import Path

import pytest

from benchmarks.tiny_vlm import write_tiny_vlm


@pytest.fixture(scope="session")
def tiny_vlm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the model; tests that ask for it are skipped where transformers is not installed."""
    for package in ("transformers", "num2words", "tokenizers"):
        pytest.importorskip(
            package, reason="smolvla needs transformers: pip install 'lerobot_policy_swr[vla]'"
        )
    return write_tiny_vlm(tmp_path_factory.mktemp("vlm"))
