"""Results as JSON files, with what it takes to make them again."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lerobot_swr.whole_files import write_whole


def write_json(path: Path, result: Any, provenance: dict[str, Any]) -> None:
    """Write a result dataclass and where it comes from, all or nothing."""
    write_whole(path, json.dumps({**asdict(result), "provenance": provenance}, indent=2) + "\n")
