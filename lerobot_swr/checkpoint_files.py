"""Are a checkpoint's files whole? Asked before anything is made of them, so that damage is told by name."""

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
from safetensors import SafetensorError, safe_open

SUFFIXES = (".json", ".safetensors", ".parquet")


def check_files(folder: Path) -> None:
    """Refuse a folder one of whose files is damaged.

    Nothing in a checkpoint is code: these three kinds of files are read as data.

    Raises:
        ValueError: Naming the file.
    """
    for file in sorted(folder.iterdir()):
        if file.suffix not in SUFFIXES or not file.is_file():
            continue
        try:
            _read(file)
        except (ValueError, OSError, SafetensorError, pa.ArrowException) as error:
            raise ValueError(
                f"{file}: damaged file ({error}); copy or download the checkpoint again"
            ) from error


def _read(file: Path) -> None:
    if file.suffix == ".json":
        json.loads(file.read_bytes())
    elif file.suffix == ".parquet":
        pq.read_metadata(file)
    else:
        with safe_open(str(file), framework="np"):  # compares the sizes of header and file
            pass
