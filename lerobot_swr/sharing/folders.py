"""Folders to upload: what others need of a checkpoint or a dataset, with a card, and no code."""

import os
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path

from lerobot_swr.checkpoint_files import check_files

POLICY_FILES = ("*.safetensors", "*.json", "*.yaml", "styles.parquet")
"""What a checkpoint consists of; everything in it is data, none of it is run when it is loaded."""
DATASET_PARTS = ("meta", "data", "videos", "images")
CARD = "README.md"
TAG = "lerobot_policy_swr"
"""Of every card that this package writes."""


@contextmanager
def new_folder(folder: Path, overwrite: bool) -> Iterator[Path]:
    """A folder that appears when it is complete.

    Args:
        folder: Its place.
        overwrite: Replace one that this command wrote before.

    Raises:
        FileExistsError: If it exists and is not to be replaced.
    """
    is_own = folder.is_dir() and _is_shared(folder)
    if folder.exists() and not (overwrite and is_own):
        advice = "pass --overwrite=true to replace it" if is_own else "choose another folder"
        raise FileExistsError(f"output_dir={str(folder)!r} already exists; {advice}")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as work:
        new = Path(work) / "new"
        new.mkdir()
        yield new
        if folder.exists():
            folder.rename(Path(work) / "old")
        new.rename(folder)


def _is_shared(folder: Path) -> bool:
    """Whether a folder holds one of our cards, and nothing but what comes with it."""
    card = folder / CARD
    if not card.is_file() or TAG not in card.read_text(encoding="utf-8", errors="replace"):
        return False
    patterns = (*POLICY_FILES, *DATASET_PARTS, CARD, "*.png", ".gitattributes")
    return all(any(fnmatch(file.name, pattern) for pattern in patterns) for file in folder.iterdir())


def copy_checkpoint(checkpoint: Path, folder: Path) -> None:
    """Copy a checkpoint's own files, after reading each of them.

    Raises:
        ValueError: If one is damaged.
    """
    check_files(checkpoint)
    for pattern in POLICY_FILES:
        for file in checkpoint.glob(pattern):
            shutil.copyfile(file, folder / file.name)


def copy_dataset(root: Path, folder: Path) -> None:
    """A dataset's own files; recordings, which are large, as links where the disk allows."""
    for part in DATASET_PARTS:
        if (root / part).is_dir():
            copy = shutil.copy2 if part == "meta" else _link_or_copy
            shutil.copytree(root / part, folder / part, copy_function=copy)


def copy_pictures(places: Sequence[Path], folder: Path) -> list[str]:
    """Copy the pictures beside result files; their names, in order."""
    folders = dict.fromkeys(place if place.is_dir() else place.parent for place in places)
    names: list[str] = []
    for number, source in enumerate(folders):
        for picture in sorted(source.glob("*.png")):
            name = picture.name if picture.name not in names else f"{picture.stem}-{number}.png"
            shutil.copyfile(picture, folder / name)
            names.append(name)
    return names


def _link_or_copy(source: str, target: str) -> str:
    try:
        os.link(source, target)
    except OSError:  # another disk, or one without hard links
        shutil.copyfile(source, target)
    return target
